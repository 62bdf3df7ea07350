# SPDX-License-Identifier: Apache-2.0
"""Fair shares of a bounded resource: an owner may hold as much as is still free.

An owner is the name of an API key. A single owner reaches half of the resource, two reach a third
each, n reach 1 / (n + 1) each. A newcomer therefore always finds room, and no share needs to be
configured. The rule is that of dynamic buffer thresholds in network switches (Choudhury and Hahne,
IEEE/ACM Transactions on Networking 6(2), 1998).
"""

from collections.abc import Callable
from typing import Any

from pugeo_service.problems import NO_SETTING, ProblemError

__all__ = ["check_share"]


def check_share(
    unit: str,
    resource: str,
    setting: str | None,
    *,
    held: int,
    held_elsewhere: int,
    wanted: int,
    free: int,
    retry_after: Callable[[float], float],
) -> None:
    """Refuse a request that would give an owner more than is left for all other owners.

    An owner that holds nothing else is never refused, however much it asks for.

    Args:
        unit: counted unit in the plural, such as ``"bytes"``.
        resource: name of the resource, for the error text.
        setting: name of the setting that raises the capacity, and by that each share; ``None`` if
            the capacity is fixed.
        held: units that the owner holds.
        held_elsewhere: units that the owner holds through its other requests.
        wanted: further units; 0 is never refused.
        free: units that no owner holds.
        retry_after: estimates the seconds until the owner has returned a number of units.

    Raises:
        ProblemError: 429.
    """
    if not wanted or not held_elsewhere or held + wanted <= free:
        return
    # A returned unit lowers ``held`` and raises ``free``, so half of the gap is enough.
    seconds = retry_after((held + wanted - free) / 2)
    detail = (
        f"This API key holds {held:,} {unit} of {resource} and asks for {wanted:,} more, but "
        f"{free:,} are free and it may hold no more than that. Try again after the time in "
        "Retry-After."
    )
    fields: dict[str, Any] = {"unit": unit, "held": held, "wanted": wanted, "free": free}
    if setting is None:
        detail = f"{detail} {NO_SETTING}"
    else:
        detail = f"{detail} A larger {setting} gives each key more."
        fields["setting"] = setting
    raise ProblemError(429, "share_exceeded", detail, retry_after=seconds, fields=fields)
