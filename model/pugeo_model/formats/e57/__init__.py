# SPDX-License-Identifier: Apache-2.0
"""E57, the exchange format of terrestrial laser scanners, by pye57 (extra ``e57``)."""

from pugeo_model.cloud import Cloud
from pugeo_model.formats.e57.decode import read
from pugeo_model.formats.e57.encode import WRITTEN, write

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "drops", "read", "sniff", "write"]

NAME = "e57"
EXTENSIONS: tuple[str, ...] = (".e57",)
MEDIA_TYPES: tuple[str, ...] = ("model/e57", "application/x-e57")


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is an E57 file."""
    return head.startswith(b"ASTM-E57")


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    found = [name for name in cloud.scalars if name not in WRITTEN and name != "scan"]
    if cloud.colors is not None and cloud.colors.shape[1] == 4:
        found.append("alpha")
    return found
