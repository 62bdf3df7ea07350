# SPDX-License-Identifier: Apache-2.0
"""Reads broken files one after the other and notes whatever comes out but a ``CloudError``.

Runs in a process of its own (``python -m benchmarks.reliability.trial``), because a crash is one of
the things looked for. The number of the present input stands in a file that outlives the process.
"""

import io
import json
import mmap
import random
import resource
import sys
import time
import traceback
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.reliability.corpus import corpus
from benchmarks.reliability.mutations import Mutator
from pugeo_model import formats
from pugeo_model.errors import CloudError
from pugeo_model.formats import Limits

__all__ = ["LIMITS", "SECONDS", "Input", "Trial", "allowance", "inputs", "read_one"]

SECONDS = 2.0
LIMITS = Limits(max_points=200_000, max_bytes=8 << 20)
# What a reader may allocate: a floor for its blocks and tables, and a multiple of the file. A row
# of JSON is the worst: 8 bytes of text become a tuple of three floats.
_FLOOR_BYTES = 6 << 20
_FACTOR = 48
_SEAM = 1000  # inputs with Python's default warnings, then as many where each is an error


@dataclass(frozen=True)
class Input:
    """A broken file.

    Attributes:
        kind: the format that it was made from.
        format: what the reader is told, or ``None``: it finds out, as for most requests.
        data: the bytes.
    """

    kind: str
    format: str | None
    data: bytes


@dataclass
class Trial:
    """Results of many inputs.

    Attributes:
        start: number of the first input.
        stop: one more than that of the last.
        outcomes: format and outcome (``"read"``, or the code of the error) -> how often.
        findings: what must not be.
        slowest_s: longest processor time of one input.
        largest_share: largest peak of memory over what is allowed.
        rss_early: peak resident bytes after a fiftieth of the inputs.
        rss_late: peak resident bytes at the end.
    """

    start: int
    stop: int
    outcomes: dict[str, int] = field(default_factory=dict)
    findings: list[dict[str, Any]] = field(default_factory=list)
    slowest_s: float = 0.0
    largest_share: float = 0.0
    rss_early: int = 0
    rss_late: int = 0


def inputs(seed: int, kinds: Sequence[str] = ()) -> Callable[[int], Input]:
    """A function from the number of an input to the input; of some ``kinds`` of files only."""
    mutator = Mutator(corpus(), kinds)
    names = list(formats.FORMATS)

    def make(index: int) -> Input:
        rng = random.Random(f"{seed}:{index}")
        kind, data = mutator.make(rng)
        told = rng.random()
        return Input(kind, None if told < 0.6 else kind if told < 0.85 else rng.choice(names), data)

    return make


def allowance(data: bytes) -> int:
    """Bytes that reading ``data`` may allocate at one time."""
    packed = data[:4] in (b"PK\x03\x04", b"LASF", b"ASTM") or b"binary_compressed" in data[:4096]
    unpacked = 4 * LIMITS.max_bytes if packed else 0
    return _FLOOR_BYTES + _FACTOR * len(data) + unpacked


def read_one(one: Input) -> str:
    """Read an input; ``"read"`` or the code of the error. Everything else comes out as it is."""
    try:
        formats.read(io.BytesIO(one.data), format=one.format, limits=LIMITS)
    except CloudError as error:
        # What the service sends must be fit for JSON.
        json.dumps(error.fields)
        return error.code
    return "read"


def run(seed: int, kinds: Sequence[str], start: int, stop: int, place: "mmap.mmap") -> Trial:
    """Read the inputs ``start`` to ``stop``; the present one's number stands in ``place``."""
    make, trial = inputs(seed, kinds), Trial(start, stop)
    outcomes: Counter[str] = Counter()
    # Compiles and imports what is compiled and imported once a process.
    for data in (each for files in corpus().values() for each in files):
        read_one(Input("", None, data))
    with warnings.catch_warnings(), _traced():
        for index in range(start, stop):
            place[:8] = index.to_bytes(8, "little")
            if index == start or index % _SEAM == 0:
                warnings.simplefilter("error" if index // _SEAM % 2 else "default")
            if index - start == (stop - start) // 50:
                trial.rss_early = _peak_rss()
            _try(index, make(index), trial, outcomes)
    trial.outcomes, trial.rss_late = dict(outcomes), _peak_rss()
    return trial


def _try(index: int, one: Input, trial: Trial, outcomes: Counter[str]) -> None:
    """Read one input and enter what happened."""
    tracemalloc.reset_peak()
    before, began = tracemalloc.get_traced_memory()[0], time.thread_time()
    try:
        outcomes[f"{one.kind} {read_one(one)}"] += 1
    except BaseException:  # noqa: BLE001 - whatever it is, it is what is looked for
        trial.findings.append({"index": index, "what": traceback.format_exc(limit=-6)})
    spent = time.thread_time() - began
    peak = tracemalloc.get_traced_memory()[1] - before
    share = peak / allowance(one.data)
    if spent > SECONDS:
        trial.findings.append({"index": index, "what": f"took {spent:.1f} s"})
    if share > 1.0:
        what = f"{peak:,} bytes for a file of {len(one.data):,}"
        trial.findings.append({"index": index, "what": what})
    trial.slowest_s = max(trial.slowest_s, spent)
    trial.largest_share = max(trial.largest_share, share)


@contextmanager
def _traced() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


def _peak_rss() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _main() -> None:
    seed, start, stop = (int(value) for value in sys.argv[1:4])
    # The mutations make text of any kind: what readers warn of is noise here, unless an error.
    sys.stderr = io.StringIO()
    with Path(sys.argv[4]).open("r+b") as file, mmap.mmap(file.fileno(), 8) as place:
        kinds = [kind for kind in sys.argv[5].split(",") if kind]
        trial = run(seed, kinds, start, stop, place)
    sys.stdout.write(json.dumps(asdict(trial)))


if __name__ == "__main__":
    _main()
