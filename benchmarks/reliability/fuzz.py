# SPDX-License-Identifier: Apache-2.0
"""Broken files for all readers: only a ``CloudError`` may come out, soon, and for little memory."""

import argparse
import json
import mmap
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.reliability import trial
from benchmarks.reliability.processes import psutil
from benchmarks.reliability.trial import Trial
from benchmarks.reliability.verdict import Claim, verdict

__all__ = ["arguments", "main"]

# Inputs for one process: enough to see a leak, few enough that a crash costs little.
_SLICE = 50_000
_POLL_S = 0.5
_STUCK_S = 120.0  # without using the processor at all
_GROWTH_BYTES = 64 << 20


@dataclass
class _Total:
    """Findings of all processes."""

    outcomes: Counter[str] = field(default_factory=Counter)
    findings: list[dict[str, Any]] = field(default_factory=list)
    slowest_s: float = 0.0
    largest_share: float = 0.0
    growth: int = 0
    done: int = 0

    def add(self, part: Trial) -> None:
        self.outcomes.update(part.outcomes)
        self.findings += part.findings
        self.slowest_s = max(self.slowest_s, part.slowest_s)
        self.largest_share = max(self.largest_share, part.largest_share)
        if part.rss_early:
            self.growth = max(self.growth, part.rss_late - part.rss_early)
        self.done += part.stop - part.start


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--inputs", type=int, default=1_000_000, help="how many [1000000]")
    parser.add_argument("--seed", type=int, default=1, help="another one gives other inputs [1]")
    parser.add_argument("--kinds", default="", help="only files made from these: las,laz [all]")
    parser.add_argument("--replay", type=int, help="read this one input again and say what happens")
    parser.add_argument("--save", type=Path, help="with --replay: write its bytes to this file")


def _environment() -> dict[str, str]:
    """Variables of the process that reads.

    The library of LAZ is in Rust, which keeps its tables of symbols in memory after the first trace
    that it prints: 46 MiB that are no growth.
    """
    return {**os.environ, "RUST_BACKTRACE": "0"}


def main(options: argparse.Namespace) -> int:
    """Read them all; return the exit status."""
    if options.replay is not None:
        return _replay(options)
    total, start, begun = _Total(), 0, time.monotonic()
    while start < options.inputs:
        stop = min(start + _SLICE, options.inputs)
        start = _slice(options, start, stop, total)
        rate = start / (time.monotonic() - begun)
        print(
            f"{start:,} of {options.inputs:,}, {rate:,.0f} a second, "
            f"{len(total.findings)} findings",
            file=sys.stderr,
            flush=True,
        )
    return _report(total, options, time.monotonic() - begun)


def _slice(options: argparse.Namespace, start: int, stop: int, total: _Total) -> int:
    """Read some inputs in a process of their own; return the number of the next one to read."""
    with tempfile.TemporaryDirectory() as folder:
        note, answer = Path(folder) / "number", Path(folder) / "trial.json"
        note.write_bytes(start.to_bytes(8, "little"))
        command = [sys.executable, "-X", "faulthandler", "-m", "benchmarks.reliability.trial"]
        command += [str(value) for value in (options.seed, start, stop, note, options.kinds)]
        with (
            answer.open("wb") as stdout,
            note.open("r+b") as file,
            mmap.mmap(file.fileno(), 8) as place,
            subprocess.Popen(
                command, stdout=stdout, stderr=subprocess.DEVNULL, env=_environment()
            ) as process,
        ):
            what = _watch(process, place)
            index = int.from_bytes(place[:8], "little")
        if what is None:
            total.add(Trial(**json.loads(answer.read_text())))
            return stop
    total.findings.append({"index": index, "what": what})
    # The part before it is good as far as it went, but its report died with the process.
    if index > start:
        _slice(options, start, index, total)
    return index + 1


def _watch(process: "subprocess.Popen[bytes]", place: "mmap.mmap") -> str | None:
    """Wait for a process; return why it had no good end, or ``None``."""
    watched = psutil.Process(process.pid)
    index, cpu, since = -1, 0.0, time.monotonic()
    while True:
        try:
            status = process.wait(_POLL_S)
        except subprocess.TimeoutExpired:
            status = None
        if status is not None:
            return None if status == 0 else f"the process ended with status {status}"
        now, used = int.from_bytes(place[:8], "little"), sum(watched.cpu_times()[:2])
        if now != index:
            index, cpu, since = now, used, time.monotonic()
        # Processor time: on a shared core, a second of the clock says nothing. The process itself
        # reports what is slow; this is for what never ends.
        elif used - cpu > 10 * trial.SECONDS or time.monotonic() - since > _STUCK_S:
            process.kill()
            process.wait()
            return f"stuck: {used - cpu:.1f} s of processor time"


def _replay(options: argparse.Namespace) -> int:
    index, save = options.replay, options.save
    kinds = [kind for kind in options.kinds.split(",") if kind]
    one = trial.inputs(options.seed, kinds)(index)
    print(f"input {index}: made from {one.kind}, read as {one.format}, {len(one.data):,} bytes")
    if save is not None:
        save.write_bytes(one.data)
    print("outcome:", trial.read_one(one))
    return 0


def _report(total: _Total, options: argparse.Namespace, seconds: float) -> int:
    kinds = sorted({key.partition(" ")[0] for key in total.outcomes})
    figures = [
        ("inputs", f"{total.done:,}, seed {options.seed}"),
        ("wall clock", f"{seconds:,.0f} s"),
    ]
    for kind in kinds:
        counted = ((key.split(" "), n) for key, n in total.outcomes.items())
        mine = {outcome: n for (made, outcome), n in counted if made == kind}
        read = mine.pop("read", 0)
        figures.append(
            (
                f"made from {kind}",
                f"{read:,} read, {sum(mine.values()):,} refused with {len(mine)} codes",
            )
        )
    for finding in total.findings[:10]:
        text = str(finding["what"]).strip().splitlines()[-1][:120]
        print(f"input {finding['index']}: {text}", file=sys.stderr)
    limits = trial.LIMITS
    claims = [
        Claim(
            "only CloudError comes out; no crash, no hang (2 s), no memory beyond the bound",
            f"{len(total.findings)} of {total.done:,} inputs",
            not total.findings and total.done == options.inputs,
        ),
        Claim(
            "an input takes less than 2 s of the processor",
            f"slowest {total.slowest_s:.2f} s",
            total.slowest_s < trial.SECONDS,
        ),
        Claim(
            "allocated at once: at most 6 MiB + 48 times the file, for packed files + 4 times "
            f"the {limits.max_bytes >> 20} MiB that they may unpack to",
            f"{100 * total.largest_share:.0f} % of that at most",
            total.largest_share <= 1.0,
        ),
        Claim(
            f"no growth over {_SLICE:,} inputs (less than {_GROWTH_BYTES >> 20} MiB)",
            f"{total.growth / 2**20:.0f} MiB at most",
            total.growth < _GROWTH_BYTES,
        ),
    ]
    raw = {"seed": options.seed, "outcomes": dict(total.outcomes), "found": total.findings[:1000]}
    return verdict("fuzz", options.out, claims, figures, raw, os.sched_getaffinity(0))
