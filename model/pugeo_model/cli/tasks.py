# SPDX-License-Identifier: Apache-2.0
"""One file to upsample, how it is done, and the outcome."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer

from pugeo_model.install import install_hint

__all__ = ["CommandError", "Outcome", "Task", "TaskSettings", "label", "needed_extra"]


class CommandError(Exception):
    """A command cannot be done as asked; the text names the thing and the way out."""


@dataclass(frozen=True)
class Task:
    """One cloud to upsample.

    Attributes:
        source: the input; ``None`` for standard input.
        target: the output; ``None`` for standard output.
        read_as: format of the input, ``None`` if only reading it will tell.
        format: format of the output, ``None`` for that of the input.
        size: bytes of the input, by which progress is weighted.
        error: the reason for which it cannot be done at all.
    """

    source: Path | None
    target: Path | None
    read_as: str | None = None
    format: str | None = None
    size: int = 1
    error: str | None = None


@dataclass(frozen=True)
class TaskSettings:
    """The same for all tasks of a run.

    Attributes:
        options: keyword arguments of :class:`pugeo_model.options.Options`.
        model: name or path of the weights; ``None``: the default.
        mesh: file for a mesh of the result, or ``None``.
    """

    options: dict[str, Any]
    model: str | None = None
    mesh: Path | None = None

    @property
    def weights(self) -> str:
        """Name or path of the weights to run here."""
        return self.model or "standard"


@dataclass(frozen=True)
class Outcome:
    """The end of a task.

    Attributes:
        source: name of the input.
        target: name of the output.
        status: ``written``, ``skipped`` or ``failed``.
        report: counts and notes of a written file: ``points_in``, ``points_out``, ``dropped``,
            ``notes`` and what else is known.
        error: sentences for a person, of a failed one.
        seconds: that it took.
    """

    source: str
    target: str
    status: str
    report: dict[str, Any] = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0


def label(path: Path | None) -> str:
    """Name of a file in messages; ``-`` for standard input or output."""
    return "-" if path is None else str(path)


def needed_extra(missing: ModuleNotFoundError, extra: str) -> typer.BadParameter:
    """The error that a library is missing, with the extra that brings it along."""
    return typer.BadParameter(f"this needs {missing.name}: {install_hint(extra)}")
