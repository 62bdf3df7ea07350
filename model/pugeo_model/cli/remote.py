# SPDX-License-Identifier: Apache-2.0
"""Tasks on a service, by the client that is installed beside the model."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import IO, Any, Protocol

from pugeo_model.cli.local import Progress
from pugeo_model.cli.tasks import CommandError, Outcome, Task, TaskSettings, label

__all__ = ["RemoteService", "connect", "run_remotely"]


class RemoteService(Protocol):
    """A service, as the entry point ``client`` of the group ``pugeo.services`` gives it."""

    @property
    def error_type(self) -> type[Exception]:
        """Base class of the errors of its calls; their texts are for people."""

    def upsample(
        self,
        source: Path | IO[bytes],
        target: Path | IO[bytes],
        format: str,
        options: dict[str, Any],
        progress: Callable[[str, int, int], None],
    ) -> dict[str, Any]:
        """Upsample a cloud; returns ``points_in``, ``points_out``, ``dropped``, ``notes``."""

    def each(
        self, call: Callable[[Task], Outcome], items: Iterable[Task], concurrency: int
    ) -> Iterator[Outcome]:
        """Make calls side by side; outcomes come in order."""

    def close(self) -> None:
        """Close all connections."""


def connect(url: str, *, as_jobs: bool) -> RemoteService:
    """Find the client of a service.

    Args:
        url: address of the service.
        as_jobs: submit jobs, which survive restarts of the service.

    Raises:
        CommandError: no client is installed, or the address or the key cannot be used.
    """
    for entry in entry_points(group="pugeo.services", name="client"):
        kind = entry.load()
        try:
            service: RemoteService = kind(url, as_jobs=as_jobs)
        except kind.error_type as error:
            raise CommandError(str(error)) from error
        return service
    raise CommandError("--url needs pugeo_client, which is not installed here")


def run_remotely(
    service: RemoteService,
    tasks: Sequence[Task],
    settings: TaskSettings,
    workers: int,
    progress: Progress,
) -> Iterator[Outcome]:
    """Do tasks on a service, some at a time, and yield their outcomes in order.

    Args:
        service: to work.
        tasks: each with the format of its output.
        settings: of all tasks; the weights are those of the service.
        workers: requests at the same time.
        progress: told what is done.
    """
    total, done = sum(task.size for task in tasks), 0
    options = settings.options | ({} if settings.model is None else {"model": settings.model})

    def show(stage: str, part: int, whole: int) -> None:
        if len(tasks) == 1:
            progress(stage, part / whole if whole else 0.0)

    def call(task: Task) -> Outcome:
        begin = time.monotonic()
        source, target = label(task.source), label(task.target)
        assert task.format is not None
        try:
            report = service.upsample(
                task.source or sys.stdin.buffer,
                task.target or sys.stdout.buffer,
                task.format,
                options,
                show,
            )
        except (service.error_type, OSError) as error:
            return Outcome(source, target, "failed", error=str(error))
        report |= {"format": task.format, "read_as": task.read_as}
        return Outcome(source, target, "written", report, seconds=time.monotonic() - begin)

    for number, outcome in enumerate(service.each(call, tasks, workers)):
        done += tasks[number].size
        if len(tasks) > 1:
            progress(f"{number + 1} of {len(tasks)} files", done / total)
        yield outcome
