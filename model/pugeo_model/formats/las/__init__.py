# SPDX-License-Identifier: Apache-2.0
"""LAS, the exchange format of LiDAR, uncompressed; `laz` is its compressed twin."""

from typing import IO

from pugeo_model.cloud import Cloud
from pugeo_model.formats.las.decode import declared, read
from pugeo_model.formats.las.encode import encode

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "declared", "drops", "read", "sniff", "write"]

NAME = "las"
EXTENSIONS: tuple[str, ...] = (".las",)
MEDIA_TYPES: tuple[str, ...] = ("application/vnd.las",)


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a LAS or LAZ file."""
    return head.startswith(b"LASF")


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write LAS; see `encode.encode` for scale, offset, dimensions and headers."""
    encode(cloud, file, compress=False)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    found = []
    if cloud.colors is not None and cloud.colors.shape[1] == 4:
        found.append("alpha")
    return found
