# SPDX-License-Identifier: Apache-2.0
"""A connection that ends with its client, and does not bear with one for ever.

These are gaps of uvicorn's fast parser. Of several requests sent at once it forgets the one that
it is working on, so that answering it after the client left is an error. It never hangs up on a
client that asked for something large and leaves it lying, nor on one that goes on sending the
body of a request that was refused.
"""

import asyncio
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

from pugeo_service.http.request_limits import BoundedHeads

__all__ = ["Connection"]

# Seconds in which a client must take at least something of what waits for it.
DEAF_S = 30.0
# Seconds in which the rest of a body is thrown away that was refused: most clients look for an
# answer only when they have sent everything, and a reset would take it away from them.
LINGER_S = 30.0


class Connection(BoundedHeads):
    """What uvicorn makes for every client."""

    _answering: RequestResponseCycle | None = None
    _patience: asyncio.TimerHandle | None = None
    _linger: asyncio.TimerHandle | None = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell whoever is at work for this client, and drop what it had asked for besides."""
        self._stop_patience()
        self._stop_linger()
        self.pipeline.clear()
        working = self._answering
        if working is not None and not working.response_complete:
            working.disconnected = True
            working.message_event.set()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """See that a body which nobody reads comes to an end, and so an answer."""
        answered = self._answering
        super().on_response_complete()
        if answered is not None and answered.more_body:
            self._linger = self.loop.call_later(LINGER_S, self.transport.abort)
        # What is left may be too little to count as slow; yet closing would wait for it for ever.
        left = self.transport.get_write_buffer_size()
        if left and self._patience is None:
            self._wait_for_reader(left)

    def on_message_complete(self) -> None:
        """It did."""
        self._stop_linger()
        super().on_message_complete()

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
        self._patience = None
        if waiting and waiting < waited:
            self._wait_for_reader(waiting)
        elif waiting:
            # Closing would wait for the buffer to drain, which is what never happens.
            self.transport.abort()

    def _stop_linger(self) -> None:
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None

    def _stop_patience(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None
