# SPDX-License-Identifier: Apache-2.0
"""Worker processes that this process has started, however they are."""

import contextlib
import os

import psutil

__all__ = ["end_children"]


def end_children() -> int:
    """End all processes of this process's own that run workers; return their number.

    A signal that cannot be caught ends those too that are stopped or hang.
    """
    ended = 0
    for child in psutil.Process(os.getpid()).children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if "spawn_main" in " ".join(child.cmdline()):
                child.kill()
                ended += 1
    return ended
