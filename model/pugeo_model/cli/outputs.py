# SPDX-License-Identifier: Apache-2.0
"""Outputs of a command, chosen and checked before any work."""

import os
from collections.abc import Sequence
from pathlib import Path

from pugeo_model.cli.inputs import Found, format_of, is_pattern
from pugeo_model.cli.tasks import CommandError, Task, label
from pugeo_model.errors import UnsupportedFormatError
from pugeo_model.formats import WRITABLE, output_format, written_as
from pugeo_model.formats.stream import is_stream

__all__ = ["check_replaced", "folder_of", "make_tasks"]


def folder_of(out: str, arguments: Sequence[Path]) -> Path | None:
    """The folder that ``-o`` names, or ``None`` if it names a file.

    It is a folder if it ends with a separator, if it is one already, or if there is more than one
    input.

    Args:
        out: the value of ``-o``.
        arguments: the inputs as they were given.

    Raises:
        CommandError: several inputs, and an output that is a file or standard output.
    """
    several = len(arguments) > 1 or any(each.is_dir() or is_pattern(each) for each in arguments)
    ends = out.endswith(("/", os.sep))
    if out == "-":
        if several:
            raise CommandError("several inputs do not fit into standard output: give -o a folder")
        return None
    path = Path(out)
    if path.is_dir() or ends or several:
        if path.exists() and not path.is_dir():
            raise CommandError(f"several inputs need a folder, but {out} is a file")
        if not ends and not path.exists() and path.suffix:
            raise CommandError(f"several inputs need a folder: write -o {out}{os.sep} if it is one")
        return path
    return None


def make_tasks(
    found: Sequence[Found], out: str, folder: Path | None, format: str | None
) -> list[Task]:
    """Choose the output of each input: its path and its format.

    In a folder an output has the name of its input, and its extension too where that belongs to
    the format. The format is the one given, else that of the extension of an output file, else
    that of the input, else PLY.

    Args:
        found: the inputs.
        out: the value of ``-o``; ``-`` is standard output.
        folder: as of `folder_of`; it is made if it is missing, with the folders in it.
        format: a key of ``WRITABLE`` for all outputs, or ``None``.

    Raises:
        CommandError: the format is not written, an output cannot be written, or two are the same.
    """
    if format is not None and format not in WRITABLE:
        raise CommandError(
            f"--format {format} cannot be written: give one of {', '.join(WRITABLE)}"
        )
    tasks: list[Task] = []
    taken: dict[str, Path | None] = {}
    for each in found:
        task = _make_task(each, out, folder, format)
        if folder is not None and task.target is not None:
            task.target.parent.mkdir(parents=True, exist_ok=True)
        _check_place(task.target)
        if task.target is not None:
            # Some file systems do not tell upper from lower case.
            place = str(task.target.resolve()).casefold()
            if place in taken:
                both = f"{label(taken[place])} and {label(task.source)}"
                raise CommandError(f"{both} would both be written to {task.target}")
            taken[place] = task.source
        tasks.append(task)
    sources = {task.source.resolve() for task in tasks if task.source is not None}
    for task in tasks:
        if task.target is not None and task.target.resolve() in sources:
            raise CommandError(f"{task.target} would replace an input: choose another -o")
    return tasks


def check_replaced(tasks: Sequence[Task]) -> None:
    """Refuse to replace files that are there.

    Raises:
        CommandError: an output exists.
    """
    targets = [task.target for task in tasks if task.target is not None]
    there = [target for target in targets if target.is_file() and not is_stream(target)]
    if there:
        more = f" and {len(there) - 1} more outputs exist" if len(there) > 1 else " exists"
        raise CommandError(
            f"{there[0]}{more}: say --overwrite to replace them, or --skip-existing to keep them"
        )


def _make_task(found: Found, out: str, folder: Path | None, format: str | None) -> Task:
    source = found.path
    read_as, error = (None, None) if source is None else format_of(source)
    size = source.stat().st_size if source is not None and source.exists() else 1
    kind = format
    if folder is None:
        target = None if out == "-" else Path(out)
        if kind is None and target is not None and target.suffix:
            try:
                kind = written_as(target)
            except UnsupportedFormatError as refused:
                raise CommandError(f"{refused.message} Or say --format.") from refused
    elif source is None:
        raise CommandError("standard input has no name for a file in a folder: give -o a file")
    if kind is None and read_as is not None:
        kind = output_format(read_as)
    if folder is not None:
        assert source is not None
        target = folder / found.folder / _named(source, kind)
    return Task(source, target, read_as, kind, max(size, 1), error)


def _named(source: Path, format: str | None) -> str:
    """Name of the output of ``source`` in a format; the extension stays where it fits."""
    if format is None:
        return source.name
    endings = WRITABLE[format].EXTENSIONS or (".ply",)
    return source.name if source.suffix.lower() in endings else source.stem + endings[0]


def _check_place(target: Path | None) -> None:
    """Refuse an output whose folder is missing or not writable."""
    if target is None:
        return
    if target.is_dir():
        raise CommandError(f"{target} is a folder: write -o {target}{os.sep} to put the file in it")
    if not target.parent.is_dir():
        raise CommandError(
            f"the folder {target.parent} of the output does not exist: make it first"
        )
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise CommandError(f"{target} cannot be written: no permission")
