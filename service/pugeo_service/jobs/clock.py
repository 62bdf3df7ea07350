# SPDX-License-Identifier: Apache-2.0
"""Clock of jobs: seconds since 1970 that a jump of the system's clock does not move at once.

Results are deleted by this clock. A clock that is days ahead for some seconds, because of a wrong
time server or a restored machine, must not delete what is kept.
"""

import time

__all__ = ["SteadyClock", "now"]

_JUMP_S = 60.0
# A jump that lasted so long is a correction.
_TRUST_S = 3600.0


class SteadyClock:
    """Follows the system's clock, apart from jumps that are not confirmed yet.

    The time since the last trusted reading is that of the monotonic clock. A difference of more
    than a minute is a jump; it counts once it lasted for an hour.
    """

    def __init__(self) -> None:
        self._offset = time.time() - time.monotonic()
        self._jumped_at: float | None = None
        self._jumped_to = 0.0

    def now(self) -> float:
        """Return the time in seconds since 1970."""
        monotonic = time.monotonic()
        offset = time.time() - monotonic
        if abs(offset - self._offset) <= _JUMP_S:
            self._offset, self._jumped_at = offset, None
            # Not the attribute: another thread may have changed it since.
            return monotonic + offset
        if self._jumped_at is None or abs(offset - self._jumped_to) > _JUMP_S:
            self._jumped_at, self._jumped_to = monotonic, offset
        elif monotonic - self._jumped_at >= _TRUST_S:
            self._offset, self._jumped_at = offset, None
        return monotonic + self._offset


now = SteadyClock().now
