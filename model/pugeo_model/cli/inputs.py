# SPDX-License-Identifier: Apache-2.0
"""Inputs of a command: files, folders, patterns and standard input to a list of files."""

import glob
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pugeo_model.errors import CloudError
from pugeo_model.formats import FORMATS, detect

__all__ = ["Found", "expand", "format_of", "is_pattern"]

_EXTENSIONS = frozenset(end for module in FORMATS.values() for end in module.EXTENSIONS)


@dataclass(frozen=True)
class Found:
    """An input.

    Attributes:
        path: the file; ``None`` for standard input.
        folder: its folder relative to the argument that it was found by, kept in the output.
    """

    path: Path | None
    folder: Path = Path()


def expand(arguments: Iterable[Path], beside: Path | None = None) -> list[Found]:
    """Find the files that the arguments of a command name, each once and in order.

    A folder stands for all files in it, and in the folders in it, with the extension of a readable
    format. A pattern with ``*``, ``?`` or ``[`` that is no file is matched here too, because some
    shells do not; ``**`` matches any folders.

    Args:
        arguments: as they were given; ``-`` is standard input.
        beside: folder of the output, in which no inputs are looked for.

    Raises:
        FileNotFoundError: a pattern matches nothing, or a folder has no such file.
    """
    found: dict[Path | None, Found] = {}
    for argument in arguments:
        for each in _expand_one(argument, None if beside is None else beside.resolve()):
            found.setdefault(each.path, each)
    return list(found.values())


def is_pattern(argument: Path) -> bool:
    """True if an argument has wildcards, and no file has this name."""
    return glob.has_magic(str(argument)) and not argument.exists()


def _expand_one(argument: Path, beside: Path | None) -> list[Found]:
    if str(argument) == "-":
        return [Found(None)]
    if argument.is_dir():
        files = sorted(path for path in argument.rglob("*") if _is_cloud(path, argument, beside))
        if not files:
            raise FileNotFoundError(
                f"no file in the folder {argument} has the extension of a readable format: "
                f"{' '.join(sorted(_EXTENSIONS))}"
            )
        return [Found(path, path.relative_to(argument).parent) for path in files]
    if is_pattern(argument):
        matching = sorted(glob.glob(str(argument), recursive=True))  # noqa: PTH207 - any pattern
        files = [Path(name) for name in matching if Path(name).is_file()]
        if not files:
            raise FileNotFoundError(f"no file matches {argument}")
        return [Found(path) for path in files]
    return [Found(argument)]


def _is_cloud(path: Path, folder: Path, beside: Path | None) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    inside = beside is not None and beside != folder.resolve() and beside in path.resolve().parents
    return path.suffix.lower() in _EXTENSIONS and not hidden and not inside and path.is_file()


def format_of(path: Path) -> tuple[str | None, str | None]:
    """Tell the format of a file by its first bytes.

    Returns:
        The format, and the reason if there is none.
    """
    try:
        with path.open("rb") as file:
            return detect(file, name=path.name), None
    except CloudError as error:
        return None, error.message
    except OSError as error:
        return None, error.strerror or str(error)
