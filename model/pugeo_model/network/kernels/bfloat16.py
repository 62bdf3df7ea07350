# SPDX-License-Identifier: Apache-2.0
"""Conversion of bfloat16 to and from its bits, since numba does not support the type.

The bits of a bfloat16 are the upper half of those of a float32.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

__all__ = ["bits", "to_bfloat16", "to_float32"]

_KINDS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def bits(tensor: Tensor) -> Any:
    """Return a numpy view of a tensor as integers of the same size, sharing its memory."""
    return tensor.view(_KINDS[tensor.element_size()]).numpy()


@njit(inline="always")
def to_bfloat16(value):  # type: ignore[no-untyped-def]
    """Round a float32 to the nearest bfloat16, ties to even; returns its bits as int16."""
    whole = np.float32(value).view(np.int32)
    odd = np.int32(np.int32(whole >> np.int32(16)) & np.int32(1))
    return np.int16(np.int32(whole + np.int32(0x7FFF) + odd) >> np.int32(16))


@njit(inline="always")
def to_float32(half):  # type: ignore[no-untyped-def]
    """Convert the bits of a bfloat16 to a float32."""
    return np.int32(np.int32(half) << np.int32(16)).view(np.float32)
