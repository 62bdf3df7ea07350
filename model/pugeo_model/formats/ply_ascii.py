# SPDX-License-Identifier: Apache-2.0
"""PLY written as text. Reading is that of ``ply``, which knows both."""

import re
from collections.abc import Iterator
from typing import IO

from pugeo_model.cloud import Cloud
from pugeo_model.formats import ply
from pugeo_model.formats.ply import declared, drops, read

__all__ = [
    "EXTENSIONS",
    "MEDIA_TYPES",
    "NAME",
    "declared",
    "drops",
    "head",
    "read",
    "rows",
    "sniff",
    "write",
]

NAME = "ply-ascii"
EXTENSIONS: tuple[str, ...] = ()
MEDIA_TYPES: tuple[str, ...] = ("text/ply", "text/x-ply")


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a PLY file that announces text."""
    return ply.sniff(head) and re.search(rb"[\r\n]format[ \t]+ascii[ \t]", head) is not None


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write text, with digits enough to read the same numbers back."""
    for block in ply.encode(cloud, text=True):
        file.write(block)


def head(cloud: Cloud, count: int) -> bytes:
    """Bytes before the rows of ``count`` points with the attributes of ``cloud``."""
    return ply.header(cloud, count=count, text=True)


def rows(cloud: Cloud) -> Iterator[bytes]:
    """The rows of some of the points."""
    return ply.body(cloud, text=True)
