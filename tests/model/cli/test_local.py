# SPDX-License-Identifier: Apache-2.0
"""Tasks in several processes, some of which end."""

import multiprocessing
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pugeo_model.cli.local import run_here, run_in_processes
from pugeo_model.cli.tasks import Outcome, Task, TaskSettings

SETTINGS = TaskSettings({"ratio": 2.0})


@pytest.fixture
def tasks(scan: Callable[..., Path], tmp_path: Path) -> list[Task]:
    """Three files."""
    paths = [scan(f"{name}.ply") for name in "abc"]
    return [Task(path, tmp_path / f"dense-{path.name}", "ply", "ply", 100) for path in paths]


def ended(outcomes: Iterator[Outcome]) -> dict[str, str]:
    return {Path(each.source).name: each.status for each in outcomes}


def test_here(tasks: list[Task]) -> None:
    """In this process progress runs over all files, and an error is the outcome of one file."""
    told: list[tuple[str, float]] = []
    outcomes = list(run_here(tasks, SETTINGS, lambda text, part: told.append((text, part))))
    assert [each.status for each in outcomes] == ["written"] * 3
    assert outcomes[0].report["points_out"] == 600
    assert {text for text, _ in told} == {f"{number} of 3 files" for number in (1, 2, 3)}
    parts = [part for _, part in told]
    assert parts == sorted(parts)
    assert parts[-1] == pytest.approx(1.0)
    wrong = Task(tasks[0].source, Path("/nowhere/x.ply"), "ply", "ply")
    (outcome,) = run_here([wrong], SETTINGS, lambda *_: None)
    assert outcome.status == "failed"
    assert "/nowhere" in str(outcome.error)


@pytest.mark.slow
def test_a_process_that_ends_costs_nothing(tasks: list[Task]) -> None:
    """A process that is killed once loses its file to another one, which writes it."""
    killed: list[int | None] = []

    def kill(_text: str, _part: float) -> None:
        if not killed:
            (victim,) = multiprocessing.active_children()[:1]
            killed.append(victim.pid)
            victim.kill()

    assert ended(run_in_processes(tasks, SETTINGS, 1, kill)) == {
        "a.ply": "written", "b.ply": "written", "c.ply": "written",
    }  # fmt: skip
    assert len(killed) == 1


@pytest.mark.slow
def test_a_process_that_ends_between_two_files(tasks: list[Task]) -> None:
    """A process that is killed while it has no file costs nothing: a new one does the rest."""
    known = set(threading.enumerate())
    outcomes = run_in_processes(tasks, SETTINGS, 1, lambda *_: None)
    first = next(outcomes)
    (child,) = multiprocessing.active_children()
    child.kill()
    # The pool notices it in a thread of its own, which ends then.
    for thread in set(threading.enumerate()) - known:
        thread.join(60)
        assert not thread.is_alive()
    rest = ended(outcomes)
    assert (first.status, rest) == ("written", {"b.ply": "written", "c.ply": "written"})


@pytest.mark.slow
def test_a_file_whose_processes_end(tasks: list[Task]) -> None:
    """Files whose processes are killed twice fail with the likely reason; nothing hangs."""

    def kill(_text: str, _part: float) -> None:
        for child in multiprocessing.active_children():
            child.kill()

    outcomes = list(run_in_processes(tasks[:1], SETTINGS, 1, kill))
    assert [each.status for each in outcomes] == ["failed"]
    assert "memory" in str(outcomes[0].error)


@pytest.mark.slow
def test_leaving_early(tasks: list[Task]) -> None:
    """Closing the generator, as Ctrl-C does, ends the processes and leaves no unfinished file."""
    outcomes = run_in_processes(tasks, SETTINGS, 2, lambda *_: None)
    next(outcomes)
    outcomes.close()  # type: ignore[attr-defined]
    assert multiprocessing.active_children() == []
    folder = tasks[0].target.parent if tasks[0].target else Path()
    assert list(folder.glob("*.part")) == []
