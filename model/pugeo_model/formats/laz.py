# SPDX-License-Identifier: Apache-2.0
"""LAZ, compressed LAS. Reading is that of ``las``, which knows both."""

from typing import IO

from pugeo_model.cloud import Cloud
from pugeo_model.formats.las import declared, drops, read
from pugeo_model.formats.las.encode import encode

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "declared", "drops", "read", "sniff", "write"]

NAME = "laz"
EXTENSIONS: tuple[str, ...] = (".laz",)
MEDIA_TYPES: tuple[str, ...] = ("application/vnd.laszip",)

_FORMAT = 104  # byte of the point format, whose upper bit says that points are compressed


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a LAZ file."""
    return head.startswith(b"LASF") and len(head) > _FORMAT and head[_FORMAT] >= 128


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write LAZ; see `encode.encode` for scale, offset, dimensions and headers."""
    encode(cloud, file, compress=True)
