# SPDX-License-Identifier: Apache-2.0
"""How time and memory grow with the cloud: ``python -m benchmarks.scale [--points N ...]``.

Bytes to bytes on one core, each size in a process of its own. The slope is that of the logarithm of
processor time over that of points: 1 is linear.
"""

import argparse
import io
import json
import resource
import subprocess
import sys
import time

import numpy as np
import torch

from benchmarks import surface
from benchmarks.machine import describe
from benchmarks.one_core import environment, pin
from pugeo_model import Cloud
from pugeo_model.formats import read, write
from pugeo_model.upsampler import Upsampler

__all__ = ["main"]

_SIZES = (10_000, 100_000, 1_000_000, 10_000_000)


def main() -> None:
    """Measure every size and print Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=_SIZES, help="of the input")
    parser.add_argument("--ratio", type=float, default=4.0)
    parser.add_argument("--model", default="standard")
    parser.add_argument("--core", type=int, help="which core; the last allowed one by default")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(_measure(options.one, options.ratio, options.model)))
        return
    machine = describe(pin(options.core))
    print("|  |  |\n| --- | --- |")
    print("\n".join(f"| {label} | {value} |" for label, value in machine))
    print("\n| points in | points out | processor time | a second of it | peak memory |")
    print("| ---: | ---: | ---: | ---: | ---: |")
    found = []
    for count in options.points:
        line = _in_a_process(count, options.ratio, options.model)
        found.append((count, line["seconds"]))
        print(
            f"| {count:,} | {line['points_out']:,} | {line['seconds']:,.1f} s "
            f"| {line['points_out'] / line['seconds']:,.0f} | {line['peak'] / 2**20:,.0f} MiB |",
            flush=True,
        )
    if len(found) > 1:
        sizes, seconds = np.log(np.array(found)).T
        print(f"\nSlope: {np.polyfit(sizes, seconds, 1)[0]:.3f}")


def _in_a_process(count: int, ratio: float, model: str) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.scale", "--one", str(count)]
    command += ["--ratio", str(ratio), "--model", model]
    done = subprocess.run(command, env=environment(), check=True, stdout=subprocess.PIPE, text=True)
    figures: dict[str, float] = json.loads(done.stdout)
    return figures


def _measure(count: int, ratio: float, model: str) -> dict[str, float]:
    torch.set_num_threads(1)
    upsampler = Upsampler(model)
    upsampler(surface.spiral(3000), ratio)  # compiles kernels, fills caches
    body = io.BytesIO()
    write(Cloud(surface.spiral(count).astype(np.float32)), body)
    begun = time.process_time()
    body.seek(0)
    result = upsampler(read(body), ratio)
    answer = io.BytesIO()
    write(result.cloud, answer)
    seconds = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"points_out": len(result.cloud), "seconds": seconds, "peak": peak}


if __name__ == "__main__":
    main()
