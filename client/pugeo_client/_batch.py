# SPDX-License-Identifier: Apache-2.0
"""Parts of `Client.map`: names of the output files, and calls in threads."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

from pugeo_client._blocking_io import Interrupt, interruptible
from pugeo_client._requests import EXTENSIONS
from pugeo_client.errors import SourceError

__all__ = ["OutputFolder", "map_in_threads", "with_source"]

_GRACE_S = 1.0  # for interrupted calls to remove their unfinished files

T = TypeVar("T")
R = TypeVar("R")
E = TypeVar("E", bound=Exception)


class OutputFolder:
    """Folder of one output file for each source, made if it is missing.

    A source that is a file keeps its name; others are called ``cloud-000000`` by their number.
    The extension is that of ``format``, else that of the source if it can be written, else
    ``.ply``.

    Args:
        folder: its path.
        format: of the output files, or None.

    Raises:
        OSError: the folder cannot be made.
    """

    def __init__(self, folder: str | os.PathLike[str], format: str | None) -> None:
        self._folder = Path(folder)
        self._format = format
        self._used: set[str] = set()
        self._folder.mkdir(parents=True, exist_ok=True)

    def path_for(self, number: int, source: Any) -> Path:
        """Return the output file of a source.

        Raises:
            SourceError: another source has the same name, or the output would replace the source.
        """
        named = getattr(source, "name", None) if hasattr(source, "read") else source
        original = Path(named) if isinstance(named, (str, os.PathLike)) else None
        stem, suffix = f"cloud-{number:06d}", ".ply"
        if original is not None and original.stem:
            stem = original.stem
            suffix = original.suffix if original.suffix.lower() in EXTENSIONS else suffix
        if self._format is not None:
            suffix = f".{self._format.partition('-')[0]}"
        target = self._folder / f"{stem}{suffix}"
        both = original is not None and target.exists() and original.exists()
        if original is not None and both and target.samefile(original):
            raise SourceError(f"the output would replace the source {original}")
        # Some file systems do not tell upper from lower case.
        if target.name.casefold() in self._used:
            raise SourceError(f"{target} is already the output of another source of this name")
        self._used.add(target.name.casefold())
        return target


def with_source(error: E, number: int, source: Any) -> E:
    """Note on an error which source it belongs to."""
    named = source if isinstance(source, (str, os.PathLike)) else type(source).__name__
    error.add_note(f"source {number}: {named}")
    return error


def map_in_threads(call: Callable[[T], R], items: Iterable[T], concurrency: int) -> Iterator[R]:
    """Call a function for each item in threads, and yield the results in order.

    Like ``ThreadPoolExecutor.map``, but at most ``concurrency`` results wait to be taken, and
    leaving the loop interrupts the calls that still run, where an executor waits for them.

    Args:
        call: makes calls of this package.
        items: its arguments, taken as they are needed.
        concurrency: calls at the same time.
    """
    interrupt = Interrupt()
    running: deque[Future[R]] = deque()

    def run(item: T, future: "Future[R]") -> None:
        try:
            with interruptible(interrupt):
                future.set_result(call(item))
        except BaseException as error:  # noqa: BLE001 - raised where the result is taken
            future.set_exception(error)

    def start(item: T) -> None:
        future: Future[R] = Future()
        # Before the thread starts, so that an interruption in between waits for it too.
        running.append(future)
        # A daemon: a call that cannot be interrupted must not keep the program from ending.
        Thread(target=run, args=(item, future), name="pugeo", daemon=True).start()

    def taken() -> R:
        # The first call stays among those that run until it has ended: an interruption of this
        # wait must wait for its thread, which removes its temporary file.
        result = running[0].result()
        running.popleft()
        return result

    try:
        for item in items:
            start(item)
            if len(running) >= concurrency:
                yield taken()
        while running:
            yield taken()
    finally:
        interrupt()
        wait(running, timeout=_GRACE_S)
