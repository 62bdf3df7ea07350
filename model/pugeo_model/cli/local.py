# SPDX-License-Identifier: Apache-2.0
"""Tasks in this process, or in one process for each processor.

A process loads the network once and then does one file after the other. A process that ends, as
when memory runs out, costs at most its own file: the files that were under way are tried again one
by one, and only the one whose process ends once more has failed.
"""

import multiprocessing
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any

from pugeo_model.cli.tasks import Outcome, Task, TaskSettings, label
from pugeo_model.errors import CloudError

if TYPE_CHECKING:
    from pugeo_model.upsampler import Upsampler

__all__ = ["MOST_PROCESSES", "run_here", "run_in_processes"]

Progress = Callable[[str, float], None]
"""Called with a text and the completed fraction of the bytes of all tasks."""

MOST_PROCESSES = 61
"""Processes that Windows can wait for at once."""

_POLL_S = 0.5


def run_here(
    tasks: Sequence[Task], settings: TaskSettings, progress: Progress
) -> Iterator[Outcome]:
    """Do tasks one after the other in this process, and yield their outcomes.

    Raises:
        BadOptionError: no such weights.
    """
    from pugeo_model.upsampler import Upsampler

    upsampler = Upsampler(settings.weights)
    total, done = sum(task.size for task in tasks), 0
    for number, task in enumerate(tasks):

        def report(
            stage: str, part: float, *, before: int = done, size: int = task.size, at: int = number
        ) -> None:
            text = stage if len(tasks) == 1 else f"{at + 1} of {len(tasks)} files"
            progress(text, (before + part * size) / total)

        yield do_task(task, settings, upsampler, report)
        done += task.size


def run_in_processes(
    tasks: Sequence[Task], settings: TaskSettings, workers: int, progress: Progress
) -> Iterator[Outcome]:
    """Do tasks in some processes, and yield their outcomes as they come.

    Args:
        tasks: files only, no standard input or output.
        settings: of all tasks.
        workers: number of processes.
        progress: told the fraction of all bytes that is done, twice a second.
    """
    context = multiprocessing.get_context("spawn")
    # Without a lock: a process that is killed could keep it for ever.
    parts = context.Array("d", len(tasks), lock=False)
    total = sum(task.size for task in tasks)

    def show() -> None:
        done = sum(part * task.size for part, task in zip(parts, tasks, strict=True))
        ended = sum(part == 1.0 for part in parts)
        progress(f"{ended} of {len(tasks)} files", done / total)

    def some(waiting: deque[int], count: int) -> Generator[Outcome, None, list[int]]:
        """Do tasks until none waits or a process ends; returns those that were under way then."""
        running: dict[Future[Outcome], int] = {}
        lost: list[int] = []
        broken = False
        pool = ProcessPoolExecutor(count, context, initializer=_start, initargs=(settings, parts))
        try:
            while (waiting and not broken) or running:
                while waiting and not broken and len(running) < count:
                    future = _submitted(pool, waiting[0], tasks[waiting[0]])
                    if future is None:
                        broken = True
                    else:
                        running[future] = waiting.popleft()
                for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
                    number = running.pop(future)
                    try:
                        outcome = future.result()
                    except BrokenProcessPool:
                        broken = True
                        lost.append(number)
                    else:
                        parts[number] = 1.0
                        yield outcome
                show()
        except BaseException:
            # Ctrl-C, or the caller leaves: files under way are not finished.
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
        return lost

    waiting, suspects = deque(range(len(tasks))), list[int]()
    while waiting:
        suspects += yield from some(waiting, workers)
    for number in suspects:
        if (yield from some(deque([number]), 1)):
            parts[number] = 1.0
            yield _lost(tasks[number])


def _submitted(pool: ProcessPoolExecutor, number: int, task: Task) -> Future[Outcome] | None:
    """The result to come of a task; ``None`` if a process has ended between two tasks."""
    try:
        return pool.submit(_do, number, task)
    except BrokenProcessPool:
        return None


def _lost(task: Task) -> Outcome:
    """Outcome of a task whose process ended twice."""
    error = (
        "its process ended, most likely because memory ran out: lower -R, or use fewer --workers"
    )
    return Outcome(label(task.source), label(task.target), "failed", error=error)


_process: dict[str, Any] = {}
"""Of a process of `run_in_processes`: its settings, its network, and the parts done."""


def _start(settings: TaskSettings, parts: Any) -> None:
    """Prepare a process: load the network, and let signals end its task cleanly."""
    from pugeo_model.upsampler import Upsampler

    # Ctrl-C reaches all processes of a terminal; the first one tells the others to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    _process.update(settings=settings, parts=parts, upsampler=Upsampler(settings.weights))


def _do(number: int, task: Task) -> Outcome:
    """Do a task in a process of `run_in_processes`."""
    parts = _process["parts"]

    def report(_stage: str, part: float) -> None:
        parts[number] = min(part, 0.99)

    return do_task(task, _process["settings"], _process["upsampler"], report)


def do_task(
    task: Task,
    settings: TaskSettings,
    upsampler: "Upsampler",
    progress: Callable[[str, float], None],
) -> Outcome:
    """Read, upsample and write one cloud; an error becomes the outcome.

    Args:
        task: to do.
        settings: of all tasks.
        upsampler: the network.
        progress: called with the name of each stage and the fraction of the work that is done.
    """
    begin = time.monotonic()
    source, target = label(task.source), label(task.target)
    try:
        report = _write_dense(task, settings, upsampler, progress)
    except CloudError as error:
        return Outcome(source, target, "failed", error=error.message)
    except MemoryError:
        text = "there is not enough memory: lower -R, or use fewer --workers"
        return Outcome(source, target, "failed", error=text)
    except OSError as error:
        return Outcome(source, target, "failed", error=_described(error))
    return Outcome(source, target, "written", report, seconds=time.monotonic() - begin)


def _write_dense(
    task: Task,
    settings: TaskSettings,
    upsampler: "Upsampler",
    progress: Callable[[str, float], None],
) -> dict[str, Any]:
    """Do a task; returns its report."""
    from pugeo_model import formats

    progress("read", 0.0)
    cloud = formats.read(task.source or sys.stdin.buffer)
    result = upsampler(
        cloud,
        **settings.options,
        progress=lambda stage, done, total: progress(stage, done / max(total, 1)),
    )
    assert cloud.source is not None
    kind = task.format or formats.output_format(cloud.source.format)
    progress("write", 1.0)
    formats.write(result.cloud, task.target or sys.stdout.buffer, format=kind)
    if task.target is None:
        sys.stdout.buffer.flush()
    lost = formats.dropped(result.cloud, kind)
    notes = [*result.report["notes"], *([lost] if lost else [])]
    report = {**result.report, "format": kind, "read_as": cloud.source.format, "notes": notes}
    if settings.mesh is not None:
        from pugeo_model.cli.mesh import write_mesh

        progress("mesh", 1.0)
        report["mesh"] = write_mesh(result.cloud, settings.mesh)
    return report


def _described(error: OSError) -> str:
    """The reason of an error of the system, and the file if it is another one than the input."""
    named = f"{error.filename}: " if error.filename else ""
    return f"{named}{error.strerror or error}"
