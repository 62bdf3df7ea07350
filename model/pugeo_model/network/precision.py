# SPDX-License-Identifier: Apache-2.0
"""Where bfloat16 is allowed: the wide products of layers, never geometry.

Inside a layer bfloat16 halves the time and costs nothing measurable. A rotation or a (u, v) in
bfloat16 would move points by 0.4 % of a spacing, as much as the error aimed at. A processor without
instructions for it emulates it, many times slower than float32: so each process tries both once.
"""

import contextlib
import functools
import time
from typing import Any

import torch

__all__ = ["bfloat16_pays", "wide_products"]

_ROWS, _WIDTH = 2048, 160  # of a layer: a patch of points by the channels of each
_TRIES = 15
# Emulated, bfloat16 takes several times as long as float32, with instructions of its own less than
# half: in between nothing is found but chance, and chance must not decide between results.
_SLOW = 1.5


def wide_products() -> Any:
    """Context in which linear layers multiply as this processor does it fastest.

    In bfloat16, accumulating in float32, or in float32 throughout.
    """
    if bfloat16_pays():
        return torch.autocast("cpu", torch.bfloat16)
    return contextlib.nullcontext()


@functools.cache
def bfloat16_pays() -> bool:
    """Whether bfloat16 is not emulated here, by the time that a layer takes: some 10 ms."""
    threads = torch.get_num_threads()
    # Of this thread alone the processor time is known, which no busy machine can lengthen.
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            return _seconds(torch.bfloat16) < _SLOW * _seconds(torch.float32)
    finally:
        torch.set_num_threads(threads)


def _seconds(kind: torch.dtype) -> float:
    """The shortest processor time that a layer's product took in some tries."""
    rows = torch.ones(_ROWS, _WIDTH, dtype=kind)
    weight = torch.ones(_WIDTH, _WIDTH, dtype=kind)
    best = float("inf")
    for _ in range(_TRIES):
        begun = time.thread_time()
        torch.nn.functional.linear(rows, weight)
        best = min(best, time.thread_time() - begun)
    return best
