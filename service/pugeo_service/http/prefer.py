# SPDX-License-Identifier: Apache-2.0
"""The ``Prefer`` header (RFC 7240): how long a client waits, and whether it wants to."""

from dataclasses import dataclass

from starlette.datastructures import Headers

__all__ = ["Preferences", "preferences"]

_MOST_DIGITS = 9


@dataclass(frozen=True)
class Preferences:
    """What a client would like; nothing that could not be left undone.

    Attributes:
        respond_async: it would rather be told where to find the answer later.
        wait: seconds, 1 or more, that it waits for the answer, counted from when the server has
            the head of the request; ``None`` where it did not say.
    """

    respond_async: bool = False
    wait: int | None = None


def preferences(headers: Headers) -> Preferences:
    """Read them. What is not understood is left out, as the RFC asks; the first one counts."""
    found: dict[str, str] = {}
    for item in ",".join(headers.getlist("prefer")).split(","):
        name, _, value = item.partition(";")[0].partition("=")
        found.setdefault(name.strip().lower(), value.strip().strip('"'))
    wait = found.get("wait", "")
    usable = wait.isdecimal() and wait.isascii() and len(wait) <= _MOST_DIGITS and int(wait) > 0
    return Preferences("respond-async" in found, int(wait) if usable else None)
