# SPDX-License-Identifier: Apache-2.0
"""Outcomes for people, as lines on stderr, or for programs, as lines of JSON on stdout."""

import json
import sys
import time
from collections import Counter
from typing import Any

from pugeo_model.cli.display import say
from pugeo_model.cli.tasks import Outcome, Task, label

__all__ = ["FAILED", "SOME_FAILED", "Summary", "count_dropped", "shown_error"]

FAILED = 2
"""Exit status if the only input cannot be used, or an option cannot."""
SOME_FAILED = 3
"""Exit status if some of several inputs failed."""

_REPORTED = (
    "read_as", "format", "points_in", "points_out", "dropped", "orient", "noise", "mesh", "notes",
)  # fmt: skip


class Summary:
    """Outcomes of a run.

    Args:
        tasks: all tasks of the run.
        quiet: print errors only.
        as_json: print a line of JSON for each file and one for all, on stdout.
    """

    def __init__(self, tasks: list[Task], *, quiet: bool, as_json: bool) -> None:
        self._tasks = {label(task.source): task for task in tasks}
        self._quiet = quiet
        self._as_json = as_json
        self._counts: Counter[str] = Counter()
        self._points = 0
        self._notes: Counter[str] = Counter()
        self._begin = time.monotonic()

    def add(self, outcome: Outcome) -> None:
        """Count an outcome and print it."""
        self._counts[outcome.status] += 1
        report = outcome.report
        self._points += report.get("points_out") or 0
        self._notes.update(report.get("notes", ()))
        if self._as_json:
            _print_json(
                {"file": outcome.source, "output": outcome.target, "status": outcome.status}
                | {name: report[name] for name in _REPORTED if name in report}
                | ({"error": outcome.error} if outcome.error else {})
                | ({"seconds": round(outcome.seconds, 3)} if outcome.seconds else {})
            )
        if outcome.error is not None:
            say(f"error: {shown_error(outcome, self._tasks.get(outcome.source))}", style="red")
        elif outcome.status == "written" and not self._quiet and not self._as_json:
            self._tell(outcome)

    def end(self) -> int:
        """Print what is known of all files together; returns the exit status."""
        counts, seconds = self._counts, time.monotonic() - self._begin
        if self._as_json:
            named = {name: counts[name] for name in ("written", "skipped", "failed")}
            _print_json(
                {"summary": named | {"points_out": self._points, "seconds": round(seconds, 3)}}
            )
        elif not self._quiet:
            several = len(self._tasks) > 1
            for note, times in self._notes.items():
                say(f"note: {note}" + (f" ({times} files)" if several else ""))
            if several:
                say(
                    f"{counts['written']} written, {counts['skipped']} skipped, "
                    f"{counts['failed']} failed: {self._points:,} points in {seconds:.0f} s"
                )
            elif counts["skipped"]:
                say("the output is there already: skipped")
        if not counts["failed"]:
            return 0
        return SOME_FAILED if len(self._tasks) > 1 else FAILED

    def _tell(self, outcome: Outcome) -> None:
        report = outcome.report
        count = report.get("points_used", report["points_in"])
        signs = f" (normals: {report['orient']})" if "orient" in report else ""
        say(f"{count:,} points -> {report['points_out']:,} points in {outcome.target}{signs}")
        if dropped := count_dropped(report["dropped"]):
            say(f"dropped {dropped}")
        if "mesh" in report:
            say(f"mesh of {report['mesh']['faces']:,} faces in {report['mesh']['file']}")


def count_dropped(dropped: dict[str, int]) -> str:
    """Return the dropped points of each reason in words; an empty text if there are none.

    Args:
        dropped: reason -> number of points, such as ``non_finite``, ``duplicate``, ``wild``.
    """
    counts = [f"{n:,} {reason.replace('_', '-')}" for reason, n in dropped.items() if n]
    return f"{' and '.join(counts)} points" if counts else ""


def shown_error(outcome: Outcome, task: Task | None) -> str:
    """The error of a file with the file and the format that it has."""
    read_as = f" ({task.read_as})" if task is not None and task.read_as is not None else ""
    return f"{outcome.source}{read_as}: {outcome.error}"


def _print_json(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()
