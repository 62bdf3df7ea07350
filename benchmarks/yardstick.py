# SPDX-License-Identifier: Apache-2.0
"""Rate of matrix products on this core, by which figures of other machines are divided."""

import math
import time

import torch

__all__ = ["gflops"]

_SIDE = 1024
_TYPES = {"bf16": torch.bfloat16, "fp32": torch.float32}


def gflops(seconds: float = 0.5) -> dict[str, float]:
    """10^9 operations a second of square products, by data type: the fastest within some seconds.

    Processor time counts: a product takes longer than the slices in which a busy core is shared.
    A machine without bfloat16 instructions converts instead, and its figure says so.
    """
    return {name: _rate(kind, seconds) for name, kind in _TYPES.items()}


def _rate(kind: torch.dtype, seconds: float) -> float:
    left, right = (torch.randn(_SIDE, _SIDE).to(kind) for _ in range(2))
    torch.mm(left, right)
    fastest = float("inf")
    end = time.perf_counter() + seconds
    while math.isinf(fastest) or time.perf_counter() < end:
        begun = time.process_time()
        torch.mm(left, right)
        fastest = min(fastest, time.process_time() - begun)
    return 2.0 * _SIDE**3 / fastest / 1e9
