# SPDX-License-Identifier: Apache-2.0
"""The ``Prefer`` header (RFC 7240): the time that a client waits for the answer."""

from starlette.datastructures import Headers

__all__ = ["preferred_wait"]

_MAX_DIGITS = 9


def preferred_wait(headers: Headers) -> int | None:
    """Read ``Prefer: wait=N``, seconds >= 1 from the head of the request; ``None`` if absent.

    Unknown and malformed preferences are ignored, as the RFC requires, and the first of several
    counts. With ``respond-async``, ``wait`` is no deadline but the time until an answer 202, so it
    is ignored as well.
    """
    found: dict[str, str] = {}
    for item in ",".join(headers.getlist("prefer")).split(","):
        name, _, value = item.partition(";")[0].partition("=")
        found.setdefault(name.strip().lower(), value.strip().strip('"'))
    wait = found.get("wait", "")
    usable = wait.isdecimal() and wait.isascii() and len(wait) <= _MAX_DIGITS and int(wait) > 0
    return int(wait) if usable and "respond-async" not in found else None
