# SPDX-License-Identifier: Apache-2.0
"""Outcomes as lines for people and as JSON, and the exit status."""

import json
from pathlib import Path

import pytest

from pugeo_model.cli.summary import Summary
from pugeo_model.cli.tasks import Outcome, Task

REPORT = {
    "points_in": 1001, "points_used": 1000, "points_out": 4000, "orient": "mst", "format": "laz",
    "dropped": {"non_finite": 0, "duplicate": 1}, "notes": ["A guess."], "tiles": 1,
}  # fmt: skip
GOOD = Outcome("a.laz", "d/a.laz", "written", REPORT, seconds=1.5)
BAD = Outcome("b.laz", "d/b.laz", "failed", error="The file ends too early.")
SKIPPED = Outcome("c.laz", "d/c.laz", "skipped")


def told(
    capsys: pytest.CaptureFixture[str], *outcomes: Outcome, **how: bool
) -> tuple[int, str, str]:
    tasks = [Task(Path(each.source), Path(each.target), "laz", "laz") for each in outcomes]
    summary = Summary(tasks, quiet=how.get("quiet", False), as_json=how.get("as_json", False))
    for outcome in outcomes:
        summary.add(outcome)
    status = summary.end()
    out, err = capsys.readouterr()
    return status, out, err


def test_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    """One file has its counts, what was dropped, and its notes."""
    status, out, err = told(capsys, GOOD)
    assert (status, out) == (0, "")
    assert err.splitlines() == [
        "1,000 points -> 4,000 points in d/a.laz (normals: mst)",
        "dropped 1 duplicate points",
        "note: A guess.",
    ]


@pytest.mark.parametrize(
    ("dropped", "words"),
    [
        ({"non_finite": 0, "wild": 0, "duplicate": 0}, []),
        ({"non_finite": 0, "wild": 3, "duplicate": 0}, ["dropped 3 wild points"]),
        (
            {"non_finite": 1234, "wild": 1, "duplicate": 2},
            ["dropped 1,234 non-finite and 1 wild and 2 duplicate points"],
        ),
    ],
)
def test_each_reason_of_dropped_points_is_counted(
    capsys: pytest.CaptureFixture[str], dropped: dict[str, int], words: list[str]
) -> None:
    """Dropped points of every reason are printed, and reasons without points are not."""
    report = {**REPORT, "dropped": dropped, "notes": []}
    _, _, err = told(capsys, Outcome("a.laz", "d/a.laz", "written", report))
    assert err.splitlines()[1:] == words


def test_an_error_names_file_and_format(capsys: pytest.CaptureFixture[str]) -> None:
    """The line of an error has the file, the format found, and the reason; quiet keeps it."""
    for quiet in (False, True):
        status, _, err = told(capsys, BAD, quiet=quiet)
        assert status == 2
        assert err == "error: b.laz (laz): The file ends too early.\n"


def test_several_files(capsys: pytest.CaptureFixture[str]) -> None:
    """Several files end with a line of counts; notes are told once; the status says some failed."""
    status, _, err = told(capsys, GOOD, BAD, SKIPPED)
    assert status == 3
    assert "note: A guess. (1 files)" in err
    assert err.splitlines()[-1].startswith("1 written, 1 skipped, 1 failed: 4,000 points in ")


def test_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    """Quiet prints nothing of files that were written."""
    assert told(capsys, GOOD, SKIPPED, quiet=True) == (0, "", "")


def test_json(capsys: pytest.CaptureFixture[str]) -> None:
    """JSON is a line for each file and one for all; errors are on stderr too."""
    status, out, err = told(capsys, GOOD, BAD, SKIPPED, as_json=True)
    good, bad, skipped, last = (json.loads(line) for line in out.splitlines())
    assert status == 3
    assert good == {
        "file": "a.laz", "output": "d/a.laz", "status": "written", "format": "laz", "seconds": 1.5,
        "points_in": 1001, "points_out": 4000, "orient": "mst", "notes": ["A guess."],
        "dropped": {"non_finite": 0, "duplicate": 1},
    }  # fmt: skip
    assert bad["status"] == "failed"
    assert bad["error"] == "The file ends too early."
    assert skipped == {"file": "c.laz", "output": "d/c.laz", "status": "skipped"}
    assert last["summary"].pop("seconds") >= 0
    assert last == {"summary": {"written": 1, "skipped": 1, "failed": 1, "points_out": 4000}}
    assert err == "error: b.laz (laz): The file ends too early.\n"
