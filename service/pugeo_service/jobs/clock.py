# SPDX-License-Identifier: Apache-2.0
"""Clock of jobs: seconds since 1970 that a jump of the system's clock does not move at once.

Results are deleted by this clock. A clock that is days ahead for some seconds, because of a wrong
time server or a restored machine, must not delete what is kept.
"""

import time

__all__ = ["SteadyClock", "deletion_time", "now"]

_JUMP_S = 60.0
# A jump that lasted so long is a correction.
_TRUST_S = 3600.0
# A time server corrects the clock of a machine within the first minutes after its start.
_SETTLE_S = 600.0


class SteadyClock:
    """Follows the system's clock, apart from jumps that are not confirmed yet.

    The time since the last trusted reading is that of the monotonic clock. A difference of more
    than a minute is a jump; it counts once it lasted for an hour. The first reading may itself be
    wrong. Until the two clocks have agreed for ten minutes, nothing is old enough to be deleted,
    and a jump back counts at once: it makes nothing older.
    """

    def __init__(self) -> None:
        monotonic = time.monotonic()
        self._offset = time.time() - monotonic
        # Start of the agreement that is not yet long enough; afterwards ``None``.
        self._agreed_since: float | None = monotonic
        self._jumped_at: float | None = None
        self._jumped_to = 0.0

    def now(self) -> float:
        """Return the time in seconds since 1970."""
        monotonic = time.monotonic()
        offset = time.time() - monotonic
        if abs(offset - self._offset) <= _JUMP_S:
            self._offset, self._jumped_at = offset, None
            since = self._agreed_since
            if since is not None and monotonic - since >= _SETTLE_S:
                self._agreed_since = None
            # Not the attribute: another thread may have changed it since.
            return monotonic + offset
        if self._agreed_since is not None:
            self._agreed_since = monotonic
            if offset < self._offset:
                self._offset, self._jumped_at = offset, None
                return monotonic + offset
        if self._jumped_at is None or abs(offset - self._jumped_to) > _JUMP_S:
            self._jumped_at, self._jumped_to = monotonic, offset
        elif monotonic - self._jumped_at >= _TRUST_S:
            self._offset, self._jumped_at = offset, None
        return monotonic + self._offset

    def deletion_time(self) -> float:
        """Return the time at which what is to be deleted must be over; 0.0 while it is in doubt."""
        found = self.now()
        return found if self._agreed_since is None else 0.0


_clock = SteadyClock()
now = _clock.now
deletion_time = _clock.deletion_time
