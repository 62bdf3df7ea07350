# SPDX-License-Identifier: Apache-2.0
"""JSON of any value in an error or a report, including numpy numbers and very large integers."""

from typing import Any

import numpy as np
from pydantic_core import to_json

__all__ = ["encode_json"]


def encode_json(value: object) -> bytes:
    """Encode a value as JSON in UTF-8, on one line.

    An error may quote a number of hundreds of digits from a request, which orjson refuses.
    NaN becomes ``null``, because neither JSON nor PostgreSQL can store it.
    """
    return to_json(value, inf_nan_mode="null", fallback=_fallback)


def _fallback(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)
