# SPDX-License-Identifier: Apache-2.0
"""The end of every harness: a table to read, a file for programs, and a status."""

import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.machine import describe

__all__ = ["Claim", "quantile", "spread", "verdict"]


@dataclass(frozen=True)
class Claim:
    """Something promised, and whether it was met.

    Attributes:
        promise: a sentence.
        found: what was measured, for people.
        holds: whether that is what was promised.
    """

    promise: str
    found: str
    holds: bool


def quantile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least ``share`` of all do not exceed; NaN where there is none."""
    if not values:
        return float("nan")
    return sorted(values)[max(0, -int(-share * len(values) // 1) - 1)]


def spread(seconds: Sequence[float], unit: Literal["s", "ms"]) -> str:
    """Median, 99th percentile and maximum of some times, for people."""
    scale, digits = (1.0, 2) if unit == "s" else (1000.0, 0)
    found = (quantile(seconds, 0.5), quantile(seconds, 0.99), max(seconds, default=float("nan")))
    shown = ", ".join(f"{scale * value:.{digits}f}" for value in found)
    return f"{shown} {unit} of {len(seconds):,}"


def verdict(
    name: str,
    out: Path,
    claims: Iterable[Claim],
    figures: Iterable[tuple[str, str]],
    raw: dict[str, Any],
    cores: Iterable[int],
) -> int:
    """Print the table, write ``out/NAME.json``; return the exit status: 1 where a claim fails.

    Args:
        name: of the harness.
        out: folder for the JSON file; made where it is missing.
        claims: what is promised.
        figures: label and value of what else was measured.
        raw: for the file: arguments and whatever a program could ask for.
        cores: what the run was allowed to use.
    """
    claims, figures = list(claims), list(figures)
    machine = [row for row in describe(None) if row[0] != "cores"]
    machine.append(("cores used", ", ".join(map(str, sorted(cores)))))
    lines = ["| promised | found | |", "| --- | --- | --- |"]
    lines += [f"| {c.promise} | {c.found} | {'holds' if c.holds else 'FAILS'} |" for c in claims]
    lines += ["", "| figure | |", "| --- | --- |"]
    lines += [f"| {label} | {value} |" for label, value in [*figures, *machine]]
    sys.stdout.write(f"\n## {name}\n\n" + "\n".join(lines) + "\n")
    out.mkdir(parents=True, exist_ok=True)
    document = {
        "harness": name,
        "ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "holds": all(claim.holds for claim in claims),
        "claims": [vars(claim) for claim in claims],
        "figures": dict(figures),
        "machine": dict(machine),
        **raw,
    }
    path = out / f"{name}.json"
    path.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    sys.stdout.write(f"\nwritten to {path}\n")
    return 0 if document["holds"] else 1
