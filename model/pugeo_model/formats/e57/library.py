# SPDX-License-Identifier: Apache-2.0
"""Access to libE57Format, which knows files by their path only."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from pugeo_model.errors import UnsupportedFormatError

__all__ = ["import_libe57", "on_disk"]


def import_libe57() -> Any:
    """Import the library that reads and writes E57.

    Raises:
        UnsupportedFormatError: it is not installed.
    """
    try:
        from pye57 import libe57
    except ImportError as missing:
        raise UnsupportedFormatError(
            "E57 needs the package pye57, which is not installed: pip install pye57.",
            code="missing_package",
        ) from missing
    return libe57


@contextmanager
def on_disk(file: IO[bytes]) -> Iterator[str]:
    """Give the path of a file with these bytes: its own, or that of a temporary copy."""
    name = getattr(file, "name", None)
    if isinstance(name, str) and file.tell() == 0:
        # Only if it still is the file that was opened.
        try:
            same = os.path.samestat(Path(name).stat(), os.fstat(file.fileno()))
        except OSError:
            same = False
        if same:
            yield name
            return
    with tempfile.TemporaryDirectory(prefix="pugeo-") as folder:
        path = Path(folder) / "cloud.e57"
        with path.open("wb") as copy:
            shutil.copyfileobj(file, copy)
        yield str(path)
