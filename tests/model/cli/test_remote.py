# SPDX-License-Identifier: Apache-2.0
"""Tasks on a service: the way to its client, and what becomes of its errors."""

import tomllib
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import IO, Any

import pytest

from pugeo_model.cli import remote
from pugeo_model.cli.remote import connect, run_remotely
from pugeo_model.cli.tasks import CommandError, Outcome, Task, TaskSettings


class BusyError(Exception):
    """An error of the service."""


class InMemory:
    """A service that copies files, and refuses those called bad."""

    error_type = BusyError

    def __init__(self, url: str, *, as_jobs: bool) -> None:
        if url == "nowhere":
            raise BusyError("nowhere is no address")
        self.as_jobs = as_jobs

    def upsample(
        self,
        source: Path | IO[bytes],
        target: Path | IO[bytes],
        format: str,
        options: dict[str, Any],
        progress: Callable[[str, int, int], None],
    ) -> dict[str, Any]:
        assert isinstance(source, Path)
        assert isinstance(target, Path)
        if source.stem == "bad":
            raise BusyError("the queue is full")
        progress("send", 1, 2)
        target.write_bytes(source.read_bytes() + format.encode())
        return {"points_in": 1, "points_out": int(options["ratio"]), "dropped": {}, "notes": []}

    def each(
        self, call: Callable[[Task], Outcome], items: Iterable[Task], concurrency: int
    ) -> Iterator[Outcome]:
        assert concurrency == 3
        return map(call, items)

    def close(self) -> None:
        """Do nothing: there are no connections."""


def test_tasks(tmp_path: Path) -> None:
    """Each task has its outcome; an error of the service or of the disk is that of one file."""
    for name in ("a", "bad"):
        (tmp_path / f"{name}.ply").write_bytes(b"ply")
    tasks = [
        Task(tmp_path / f"{name}.ply", tmp_path / f"{name}.out", "ply", "laz")
        for name in ("a", "bad", "missing")
    ]
    told: list[str] = []
    settings = TaskSettings({"ratio": 5.0})
    service = InMemory("here", as_jobs=False)
    outcomes = list(run_remotely(service, tasks, settings, 3, lambda text, _: told.append(text)))
    assert [each.status for each in outcomes] == ["written", "failed", "failed"]
    assert outcomes[0].report["format"] == "laz"
    assert outcomes[1].error == "the queue is full"
    assert (tmp_path / "a.out").read_bytes() == b"plylaz"
    assert told == ["1 of 3 files", "2 of 3 files", "3 of 3 files"]


def test_the_client_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """The client is an entry point; without one, or with a wrong address, the error says so."""
    entry = EntryPoint("client", f"{__name__}:InMemory", "pugeo.services")
    monkeypatch.setattr(EntryPoint, "load", lambda _: InMemory)
    monkeypatch.setattr(remote, "entry_points", lambda **_: [entry])
    assert isinstance(connect("here", as_jobs=True), InMemory)
    with pytest.raises(CommandError, match="nowhere is no address"):
        connect("nowhere", as_jobs=False)
    monkeypatch.setattr(remote, "entry_points", lambda **_: [])
    with pytest.raises(CommandError, match="pugeo_client"):
        connect("here", as_jobs=False)


def test_entry_points_lead_somewhere(root: Path) -> None:
    """Each entry point and script of the distribution names an object that is there."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    groups = [*project["entry-points"].values(), project["scripts"]]
    values = [value for group in groups for value in group.values()]
    assert "pugeo_client._command_line:CommandLineService" in values
    for value in values:
        module, _, name = value.partition(":")
        assert callable(getattr(import_module(module), name)), value
