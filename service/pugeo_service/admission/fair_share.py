# SPDX-License-Identifier: Apache-2.0
"""What one owner may hold of what all share: as much as is still free.

An owner is the name of an API key. One alone comes to half of the whole, two to a third each, n
to a part in n + 1: whoever comes next always finds room, and no share has to be configured.
Switches share their buffers by the same rule (dynamic thresholds).
"""

from collections.abc import Callable

from pugeo_service.problems import ProblemError

__all__ = ["check_share"]


def check_share(
    unit: str,
    pool: str,
    *,
    held: int,
    elsewhere: int,
    wanted: int,
    free: int,
    wait: Callable[[float], float],
) -> None:
    """Refuse what would give an owner more than is left for everybody else.

    An owner that holds nothing else is not refused, however much it asks for.

    Args:
        unit: what is counted, in the plural, as ``"bytes"``.
        pool: what it is a part of, for a person.
        held: units that the owner holds.
        elsewhere: those of them that it does not hold by the very thing that asks for more.
        wanted: units more; 0 is never refused.
        free: units that nobody holds.
        wait: returns seconds until the owner has given so many units back.

    Raises:
        ProblemError: 429.
    """
    if not wanted or not elsewhere or held + wanted <= free:
        return
    # What is given back is both no longer held and free: half of the gap is enough.
    seconds = wait((held + wanted - free) / 2)
    detail = (
        f"This API key holds {held:,} {unit} of {pool} and asks for {wanted:,} more, but "
        f"{free:,} are free and it may hold no more than that. Try again after the time in "
        "Retry-After."
    )
    fields = {"unit": unit, "held": held, "wanted": wanted, "free": free}
    raise ProblemError(429, "share_exceeded", detail, retry_after=seconds, fields=fields)
