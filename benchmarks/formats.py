# SPDX-License-Identifier: Apache-2.0
"""Measure how long reading and writing a million points takes, on one core, and print Markdown.

python -m benchmarks.formats [--points N] [--rounds N] [--core N]

The best round counts. Time of the processor stands beside time of the clock: on a machine with
other work the clock also counts the waiting.
"""

import argparse
import gc
import io
import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.machine import describe
from benchmarks.one_core import pin
from pugeo_model import Cloud
from pugeo_model.formats import read, write

__all__ = ["main"]

_NAMES = ("ply", "ply-ascii", "npz", "npy", "json", "xyz")


def main() -> None:
    """Write and read one cloud in every format, and print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.formats", description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000, help="points of the cloud")
    parser.add_argument("--rounds", type=int, default=5, help="of which the best counts")
    parser.add_argument("--core", type=int, help="which core; the last allowed one by default")
    options = parser.parse_args()
    for label, value in describe(pin(options.core)):
        print(f"- {label}: {value}")
    print(f"\n{options.points:,} points, best of {options.rounds} rounds, in seconds:\n")
    print("| cloud | format | MB | read: processor | clock | write: processor | clock |")
    print("|---|---|--:|--:|--:|--:|--:|")
    for kind, cloud in _clouds(options.points):
        for name in _NAMES:
            print(_row(kind, name, cloud, options.rounds), flush=True)


def _clouds(count: int) -> Iterator[tuple[str, Cloud]]:
    rng = np.random.default_rng(0)
    points = rng.random((count, 3), np.float32)
    yield "x y z", Cloud(points)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    yield "and normals, colours", Cloud(points, normals, colors)


def _row(kind: str, name: str, cloud: Cloud, rounds: int) -> str:
    buffer = io.BytesIO()

    def store() -> None:
        buffer.seek(0)
        buffer.truncate()
        write(cloud, buffer, format=name)

    def load() -> None:
        buffer.seek(0)
        read(buffer, format=name)

    written = _best(store, rounds)
    taken = _best(load, rounds)
    size = f"{buffer.getbuffer().nbytes / 1e6:.0f}"
    cells = (kind, name, size, *(f"{value:.2f}" for value in (*taken, *written)))
    return f"| {' | '.join(cells)} |"


def _best(call: Callable[[], None], rounds: int) -> tuple[float, float]:
    """Return the least processor time and the least clock time of some rounds."""
    busy, clock = [], []
    for _ in range(rounds):
        gc.collect()
        start = (time.process_time(), time.perf_counter())
        call()
        busy.append(time.process_time() - start[0])
        clock.append(time.perf_counter() - start[1])
    return min(busy), min(clock)


if __name__ == "__main__":
    main()
