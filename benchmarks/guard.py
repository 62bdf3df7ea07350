# SPDX-License-Identifier: Apache-2.0
"""Ratios of speed that hold on any machine: ``python -m benchmarks.guard`` prints them as JSON.

``tests/benchmarks/test_guard.py`` says what they may be, and asks in every run of the tests. So it
is short, and only processor time counts, the fastest of several tries: what shares the machine
makes a try slower and never faster. What is compared takes turns, so that a bad minute is bad for
both.
"""

import io
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np
import torch

from benchmarks import roofline, surface, yardstick
from benchmarks.measure import Run, upsampled
from pugeo_model import Cloud
from pugeo_model.formats import write
from pugeo_model.network.precision import bfloat16_pays
from pugeo_model.upsampler import Upsampler

__all__ = ["Ratios", "main"]

_ROUNDS = 2
_PRODUCTS_S = 0.2
_UNITS = 4.0  # times the float32 rate: vector instructions make it twice, matrix units 8 times
_SMALL, _LARGE = (3_000, 4), (12_000, 4)  # points, output points an input point
_DENSE = (3_000, 16)
# One patch each, filled up to the same 640 rows: all that is new in each is its size.
_SIZES = range(601, 641, 5)


@dataclass(frozen=True)
class Ratios:
    """The ratios that are compared.

    Attributes:
        linearity: output points a second at 12,000 input points, over that at 3,000.
        density: time at R=16 over time at R=4.
        rest: time of preparing, merging and finishing over that of the network, at R=4.
        novelty: time of the network on a cloud of a size that it has not met, over its time on the
            same cloud again.
        roofline: share of the rate of this core's matrix products that the network reaches;
            ``None`` where bfloat16 is emulated, or multiplied by units made for nothing else: what
            is not a product then takes most of the time, whatever is done about it.
    """

    linearity: float
    density: float
    rest: float
    novelty: float
    roofline: float | None

    def to_json(self) -> str:
        """The inverse of :meth:`from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of :meth:`to_json`."""
        return cls(**json.loads(text))


def main() -> Ratios:
    """Measure all of them: some ten seconds of the processor."""
    torch.set_num_threads(1)
    upsampler = Upsampler()
    cases = (_SMALL, _LARGE, _DENSE)
    upsampled(upsampler, _file(1_000), _SMALL[1])  # compiles kernels, fills caches
    speed = [yardstick.gflops(_PRODUCTS_S)]
    tries = [
        [upsampled(upsampler, _file(points), ratio) for points, ratio in cases]
        for _ in range(_ROUNDS)
    ]
    speed.append(yardstick.gflops(_PRODUCTS_S))
    small, large, dense = (_fastest(runs) for runs in zip(*tries, strict=True))
    return Ratios(
        linearity=_LARGE[0] / _SMALL[0] * small.cpu_seconds / large.cpu_seconds,
        density=dense.cpu_seconds / small.cpu_seconds,
        rest=sum(small.stages[name] for name in ("prepare", "merge", "finish"))
        / small.stages["predict"],
        novelty=_novelty(upsampler),
        roofline=_roofline(upsampler, small, speed),
    )


def _novelty(upsampler: Upsampler) -> float:
    upsampled(upsampler, _file(_SIZES[-1] - 1), _SMALL[1])  # meets the filled number of rows
    first: list[float] = []
    again: list[float] = []
    for file in map(_file, _SIZES):
        for times in (first, again):
            times.append(upsampled(upsampler, file, _SMALL[1]).stages["predict"])
    return min(first) / min(again)


def _roofline(upsampler: Upsampler, run: Run, speed: Sequence[dict[str, float]]) -> float | None:
    bf16, fp32 = (max(gflops[kind] for gflops in speed) for kind in ("bf16", "fp32"))
    if not bfloat16_pays() or bf16 > _UNITS * fp32:
        return None
    work = roofline.work(upsampler.model, _cloud(_SMALL[0]), _SMALL[1])
    return work.seconds({"bf16": bf16}) * work.charts / run.stages["predict"]


def _fastest(runs: Iterable[Run]) -> Run:
    return min(runs, key=lambda run: run.cpu_seconds)


def _cloud(points: int) -> Cloud:
    return Cloud(surface.spiral(points).astype(np.float32))


def _file(points: int) -> bytes:
    file = io.BytesIO()
    write(_cloud(points), file)
    return file.getvalue()


if __name__ == "__main__":
    sys.stdout.write(main().to_json() + "\n")
