# SPDX-License-Identifier: Apache-2.0
"""A single NumPy array (``.npy``): points, then colours and normals in further columns."""

from typing import IO

import numpy as np
from numpy.lib import format as npy

from pugeo_model.cloud import Cloud
from pugeo_model.formats.colors import to_uint8
from pugeo_model.formats.npz import NPY_MAGIC, declared, read

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "declared", "drops", "read", "sniff", "write"]

NAME = "npy"
EXTENSIONS: tuple[str, ...] = (".npy",)
MEDIA_TYPES: tuple[str, ...] = ("application/x-npy",)


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is an array."""
    return head.startswith(NPY_MAGIC)


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write x y z, red green blue (0..255), nx ny nz as far as there are any; no scalars.

    The array has the points' precision.
    """
    columns = [cloud.points]
    if cloud.colors is not None:
        columns.append(to_uint8(cloud.colors[:, :3])[0].astype(cloud.points.dtype))
    if cloud.normals is not None:
        columns.append(cloud.normals.astype(cloud.points.dtype))
    npy.write_array(file, np.concatenate(columns, axis=1), allow_pickle=False)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    found = list(cloud.scalars)
    if cloud.colors is not None and cloud.colors.shape[1] == 4:
        found.append("alpha")
    if cloud.colors is not None and cloud.colors.dtype == np.uint16:
        found.append("the lower 8 of 16 bits of colours")
    return found
