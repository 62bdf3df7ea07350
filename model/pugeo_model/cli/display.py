# SPDX-License-Identifier: Apache-2.0
"""Messages and progress on stderr: a bar on a terminal, else a plain line every few seconds."""

import signal
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

__all__ = ["CONSOLE", "Display", "progress_bar", "say", "stopped_training"]

CONSOLE = Console(stderr=True)
_INTERVAL_S = 5.0
"""Seconds between two plain lines."""
_TELLING = 0.05
"""Completed part from which on the time left is told."""
_TERMINATED = 128 + signal.SIGTERM  # status of a program that this signal ended


def say(line: str, style: str | None = None) -> None:
    """Print a line on stderr as it is: not wrapped, not marked up."""
    CONSOLE.print(line, style=style, markup=False, highlight=False, soft_wrap=True)


def stopped_training(folder: Path) -> typer.Exit:
    """Say that SIGTERM stopped a training; returns the exception that ends the command.

    Args:
        folder: of the run, or of the runs.
    """
    say(f"stopped; what is trained so far is in {folder}, and the same command goes on from there")
    return typer.Exit(_TERMINATED)


def progress_bar(*columns: TextColumn) -> Progress:
    """A bar with a name, the time left and further columns, which vanishes at its end."""
    return Progress(
        TextColumn("{task.description:<10}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(elapsed_when_finished=True),
        *columns,
        console=CONSOLE,
        transient=True,
    )


class Display:
    """Progress of a command with the time that is left; a context manager.

    Args:
        quiet: show nothing.
        interval_s: seconds between two lines where stderr is no terminal.
    """

    def __init__(self, *, quiet: bool = False, interval_s: float = _INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._quiet = quiet
        self._bar = progress_bar() if CONSOLE.is_terminal and not quiet else None
        self._task = TaskID(0) if self._bar is None else self._bar.add_task("", total=1.0)
        self._begin = self._last = time.monotonic()

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:  # fmt: skip
        if self._bar is not None:
            self._bar.stop()

    def update(self, text: str, fraction: float) -> None:
        """Show how far the work is.

        Args:
            text: present stage, or files done.
            fraction: completed part, 0 to 1.
        """
        if self._bar is not None:
            self._bar.update(self._task, description=text, completed=fraction)
            return
        now = time.monotonic()
        if not self._quiet and now - self._last >= self._interval_s:
            self._last = now
            say(f"{text}: {fraction:.0%}{_left(now - self._begin, fraction)}")


def _left(elapsed: float, fraction: float) -> str:
    """The time left in words, as far as it can be told."""
    if not _TELLING < fraction < 1:
        return ""
    seconds = elapsed * (1 - fraction) / fraction
    amount = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
    return f", about {amount} left"
