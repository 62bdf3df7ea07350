# SPDX-License-Identifier: Apache-2.0
"""Files that are there in whole or not at all."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

__all__ = ["atomic_file"]


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file beside ``path`` that takes its place when the block ends well.

    When the block raises, the new file is removed and an older one at ``path`` stays as it was.
    """
    # Beside it, not in the temporary folder: a rename is atomic only within one file system.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("xb") as file:
            yield file
        os.replace(part, path)  # noqa: PTH105 - replaces on Windows too, and says so
    except BaseException:
        part.unlink(missing_ok=True)
        raise
