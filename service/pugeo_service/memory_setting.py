# SPDX-License-Identifier: Apache-2.0
"""The setting ``worker_memory``: bytes with or without a unit, or a share of all memory."""

import re

__all__ = ["check_memory"]

_LEAST_BYTES = 768 << 20  # the model alone takes 600 MiB
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgt]?i?b?)", re.IGNORECASE)
_POWERS = {"": 0, "k": 1, "m": 2, "g": 3, "t": 4}


def check_memory(value: str) -> str:
    """Return the memory of a worker as Dask understands it.

    Args:
        value: ``auto``, bytes such as ``2GB``, or a share such as ``0.4``.

    Raises:
        ValueError: it has another form, or is less than a worker needs.
    """
    wanted = (
        "must be auto, bytes such as 2GB (at least 768MiB), or a share of all memory above 0, "
        "up to 1.0"
    )
    text = value.strip()
    size = _SIZE.fullmatch(text)
    if text == "auto":
        return text
    if size is None:
        raise ValueError(wanted)
    unit = size[2].lower()
    if not unit and float(size[1]) <= 1:
        allowed = float(size[1]) * _all_memory()
    else:
        base = 1024 if "i" in unit else 1000
        allowed = float(size[1]) * base ** _POWERS[unit.rstrip("ib")]
    if allowed < _LEAST_BYTES:
        raise ValueError(f"{wanted}; this is {int(allowed):,} bytes")
    return text


def _all_memory() -> int:
    """Return the bytes of memory that all processes together may use, as Dask counts them."""
    from distributed.system import MEMORY_LIMIT

    return MEMORY_LIMIT
