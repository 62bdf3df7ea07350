# SPDX-License-Identifier: Apache-2.0
"""How fast this core multiplies matrices: what a figure from another machine is divided by."""

import time

import torch

__all__ = ["gflops"]

_SIDE = 1024
_SECONDS = 0.5
_TYPES = {"bf16": torch.bfloat16, "fp32": torch.float32}


def gflops() -> dict[str, float]:
    """10^9 operations a second of square products, by data type: the fastest within half a second.

    A machine without bfloat16 instructions converts instead, and its figure says so.
    """
    return {name: _rate(kind) for name, kind in _TYPES.items()}


def _rate(kind: torch.dtype) -> float:
    left, right = (torch.randn(_SIDE, _SIDE).to(kind) for _ in range(2))
    torch.mm(left, right)
    fastest = float("inf")
    end = time.perf_counter() + _SECONDS
    while time.perf_counter() < end:
        begun = time.perf_counter()
        torch.mm(left, right)
        fastest = min(fastest, time.perf_counter() - begun)
    return 2.0 * _SIDE**3 / fastest / 1e9
