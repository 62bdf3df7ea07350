# SPDX-License-Identifier: Apache-2.0
"""A connection that ends with its client, and does not wait for ever for one that stopped reading.

Both are gaps of uvicorn's fast parser: of several requests sent at once it forgets the one that
it is working on, so that answering it after the client left is an error; and it never hangs up on
a client that asked for something large and leaves it lying.
"""

import asyncio
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

from pugeo_service.heads import BoundedHeads

__all__ = ["Connection"]

# Seconds in which a client must take at least something of what waits for it.
DEAF_S = 30.0


class Connection(BoundedHeads):
    """What uvicorn makes for every client."""

    _answering: RequestResponseCycle | None = None
    _patience: asyncio.TimerHandle | None = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell whoever is at work for this client, and drop what it had asked for besides."""
        self._stop_patience()
        self.pipeline.clear()
        working = self._answering
        if working is not None and not working.response_complete:
            working.disconnected = True
            working.message_event.set()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """The client reads slower than we write: see that it reads at all."""
        super().pause_writing()
        self._stop_patience()
        self._wait_for_reader(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        """It does."""
        self._stop_patience()
        super().resume_writing()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Callable[..., Any]) -> None:
        self._answering = cycle
        super()._start_asgi_task(cycle, app)

    def _wait_for_reader(self, waiting: int) -> None:
        self._patience = self.loop.call_later(DEAF_S, self._look_at_reader, waiting)

    def _look_at_reader(self, waited: int) -> None:
        waiting = self.transport.get_write_buffer_size()
        if waiting < waited:
            self._wait_for_reader(waiting)
        else:
            # Closing would wait for the buffer to drain, which is what never happens.
            self.transport.abort()

    def _stop_patience(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None
