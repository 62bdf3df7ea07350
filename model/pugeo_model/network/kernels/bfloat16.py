# SPDX-License-Identifier: Apache-2.0
"""bfloat16 as numba sees it: the bits of it, since it knows no such number.

They are the upper half of a float32's.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

__all__ = ["bits", "to_bfloat16", "to_float32"]

_KINDS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def bits(tensor: Tensor) -> Any:
    """Bits of the numbers, as integers of their size that share their memory."""
    return tensor.view(_KINDS[tensor.element_size()]).numpy()


@njit(inline="always")
def to_bfloat16(value):  # type: ignore[no-untyped-def]
    """Bits of the bfloat16 nearest to a float32, ties to even."""
    whole = np.float32(value).view(np.int32)
    odd = np.int32(np.int32(whole >> np.int32(16)) & np.int32(1))
    return np.int16(np.int32(whole + np.int32(0x7FFF) + odd) >> np.int32(16))


@njit(inline="always")
def to_float32(half):  # type: ignore[no-untyped-def]
    """The float32 that the bits of a bfloat16 stand for."""
    return np.int32(np.int32(half) << np.int32(16)).view(np.float32)
