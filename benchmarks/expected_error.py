# SPDX-License-Identifier: Apache-2.0
"""The expected error of points beside the true one: ``python -m benchmarks.expected_error``.

For each input of the evaluation the points of all shapes are divided into tenths by the error that
is expected of them. The table has the mean true distance from the surface over the mean expected
one, from the smallest expected errors to the largest. It is what `docs/quality.md` shows.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_model.expected_error import EXPECTED_ERROR
from pugeo_model.formats import read
from pugeo_model.metrics.evaluation import CASES, Case, Truth, truths
from pugeo_model.upsampler import Upsampler

_TENTHS = 10

Pair = tuple[NDArray[np.float64], NDArray[np.float64]]


def _measured(upsampler: Upsampler, case: Case, shapes: Sequence[Truth], samples: Path) -> Pair:
    """Expected and true errors of all points of a case."""
    expected, true = [], []
    for truth in shapes:
        cloud = read(samples / "inputs" / f"{truth.name}_{case.kind}.ply")
        dense = upsampler(cloud, case.ratio, confidence=True).cloud
        expected.append(dense.scalars[EXPECTED_ERROR].astype(np.float64))
        true.append(truth.distance.nearest(dense.points.astype(np.float64))[0])
    return np.concatenate(expected), np.concatenate(true)


def _row(name: str, pair: Pair) -> str:
    expected, true = pair
    parts = np.array_split(np.argsort(expected, kind="stable"), _TENTHS)
    ratios = [true[part].mean() / expected[part].mean() for part in parts]
    return f"| {name} | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("meshes", type=Path, help="folder of NAME.ply meshes, longest side 1")
    parser.add_argument("samples", type=Path, help="folder with inputs/ samples of them")
    parser.add_argument("--model", default="standard", help="released weights or a file")
    chosen = parser.parse_args()
    upsampler, shapes = Upsampler(chosen.model), list(truths(chosen.meshes))
    print("| input |" + "".join(f" {n + 1} |" for n in range(_TENTHS)))
    print("| --- |" + " ---: |" * _TENTHS)
    pairs = []
    for case in CASES:
        pairs.append(_measured(upsampler, case, shapes, chosen.samples))
        print(_row(case.name, pairs[-1]), flush=True)
    expected, true = (np.concatenate(each) for each in zip(*pairs, strict=True))
    print(_row("all", (expected, true)))


if __name__ == "__main__":
    main()
