# SPDX-License-Identifier: Apache-2.0
"""Ports for programs that cannot be told to take any port."""

import contextlib
import random
import socket

__all__ = ["free_port"]

# Below those that Linux gives to outgoing connections, which may be taken a moment later.
_RANGE = (10_000, 30_000)


def free_port() -> int:
    """Return a port of 127.0.0.1 that nobody listens on.

    It is drawn at random, so that tests in several processes hardly ever draw the same.
    """
    chance = random.SystemRandom()
    while True:
        port = chance.randrange(*_RANGE)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
