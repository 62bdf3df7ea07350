# SPDX-License-Identifier: Apache-2.0
"""Use of bfloat16: for the wide matrix products of layers, never for geometry.

Inside a layer bfloat16 halves the time without a measurable loss. A rotation or a (u, v) in
bfloat16 would move points by 0.4 % of a spacing, as much as the intended error. Processors without
instructions for bfloat16 emulate it much more slowly than float32, so each process measures both.
"""

import contextlib
import functools
import time
from typing import Any

import torch

__all__ = ["bfloat16_pays", "wide_products"]

_ROWS, _WIDTH = 2048, 160  # size of a typical layer: points of a patch, channels
_TRIES = 15
_FEWEST = 3
# Emulated products take 10 to 30 ms each, and every process would spend half a second on them.
_ENOUGH_S = 0.03
# Emulated bfloat16 takes several times as long as float32, native bfloat16 less than half. A limit
# between the two makes the decision, and so the results, independent of noise in the measurement.
_SLOW = 1.5


def wide_products() -> Any:
    """Return a context for linear layers: bfloat16 products with float32 sums, if it is faster."""
    if bfloat16_pays():
        return torch.autocast("cpu", torch.bfloat16)
    return contextlib.nullcontext()


@functools.cache
def bfloat16_pays() -> bool:
    """Return whether bfloat16 is native on this processor, from a measurement of some 10 ms."""
    threads = torch.get_num_threads()
    # With one thread the processor time can be measured, which other processes do not increase.
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            return _seconds(torch.bfloat16) < _SLOW * _seconds(torch.float32)
    finally:
        torch.set_num_threads(threads)


def _seconds(kind: torch.dtype) -> float:
    """Shortest processor time of the product of a layer: in 3 tries, or more if they are quick."""
    rows = torch.ones(_ROWS, _WIDTH, dtype=kind)
    weight = torch.ones(_WIDTH, _WIDTH, dtype=kind)
    times: list[float] = []
    while len(times) < _TRIES and (len(times) < _FEWEST or sum(times) < _ENOUGH_S):
        start = time.thread_time()
        torch.nn.functional.linear(rows, weight)
        times.append(time.thread_time() - start)
    return min(times)
