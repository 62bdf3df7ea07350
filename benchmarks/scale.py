# SPDX-License-Identifier: Apache-2.0
"""Growth of time and memory with the cloud: ``python -m benchmarks.scale [--points N ...]``.

Bytes to bytes on one core, each size in a process of its own. The slope is that of the logarithm of
processor time over that of points: 1 is linear.
"""

import argparse
import io
import json
import subprocess
import sys
import time

import numpy as np
import torch

from benchmarks import surface
from benchmarks.machine import describe, peak_bytes
from benchmarks.one_core import environment, pin
from benchmarks.report import table
from pugeo_model import Cloud
from pugeo_model.errors import BadOptionError
from pugeo_model.formats import read, write
from pugeo_model.upsampler import Upsampler

__all__ = ["main"]

_SIZES = (10_000, 100_000, 1_000_000, 10_000_000)


def main() -> None:
    """Measure every size and print Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=_SIZES, help="of the input")
    parser.add_argument("--ratio", type=float, default=4.0)
    parser.add_argument("--model", default="standard", help="name or path of the weights")
    parser.add_argument("--core", type=int, help="which core; the last allowed one by default")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(_measure(options.one, options.ratio, options.model)))
        return
    try:
        machine = describe(pin(options.core), options.model)
    except BadOptionError as error:
        parser.error(error.message)
    print("\n".join(table(("", ""), machine)), end="\n\n")
    found, rows = [], []
    for count in options.points:
        print(f"measuring {count:,} points ...", file=sys.stderr, flush=True)
        out, seconds, peak = _in_a_process(count, options.ratio, options.model)
        found.append((count, seconds))
        size = f"{peak / 2**20:,.0f} MiB"
        rows.append((f"{count:,}", f"{out:,}", f"{seconds:,.1f} s", f"{out / seconds:,.0f}", size))
    header = ("points in", "points out", "processor time", "points out a second", "peak memory")
    print("\n".join(table(header, rows)))
    if len(found) > 1:
        sizes, seconds = np.log(np.array(found)).T
        print(f"\nSlope: {np.polyfit(sizes, seconds, 1)[0]:.3f}")


def _in_a_process(count: int, ratio: float, model: str) -> tuple[int, float, int]:
    command = [sys.executable, "-m", "benchmarks.scale", "--one", str(count)]
    command += ["--ratio", str(ratio), "--model", model]
    done = subprocess.run(command, env=environment(), check=True, stdout=subprocess.PIPE, text=True)
    out, seconds, peak = json.loads(done.stdout)
    return out, seconds, peak


def _measure(count: int, ratio: float, model: str) -> tuple[int, float, int]:
    """Points of the answer, seconds of the processor, and bytes held at most."""
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
    return len(result.cloud), seconds, peak_bytes()


if __name__ == "__main__":
    main()
