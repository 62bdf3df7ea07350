# SPDX-License-Identifier: Apache-2.0
"""JSON of whatever an error or a report may hold: numbers of any size, and those of numpy."""

from typing import Any

import numpy as np
from pydantic_core import to_json

__all__ = ["plain_json"]


def plain_json(value: object) -> bytes:
    """Return a value as JSON in UTF-8, on one line.

    A client chooses some of the numbers that an error quotes, so they may have hundreds of
    digits, which orjson refuses. Not a number is ``null``: neither JSON nor PostgreSQL has it.
    """
    return to_json(value, inf_nan_mode="null", fallback=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)
