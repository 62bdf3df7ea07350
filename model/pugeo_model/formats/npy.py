# SPDX-License-Identifier: Apache-2.0
"""A single NumPy array (``.npy``): points, and normals as columns 4 to 6."""

from typing import IO

import numpy as np
from numpy.lib import format as npy

from pugeo_model.cloud import Cloud
from pugeo_model.formats.npz import NPY_MAGIC, read

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "read", "sniff", "write"]

NAME = "npy"
EXTENSIONS: tuple[str, ...] = (".npy",)
MEDIA_TYPES: tuple[str, ...] = ("application/x-npy",)


def sniff(head: bytes) -> bool:
    """Whether a file with these first bytes is an array."""
    return head.startswith(NPY_MAGIC)


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write ``(M, 3)`` or ``(M, 6)``, in the points' precision; there is no room for the rest."""
    columns = [cloud.points]
    if cloud.normals is not None:
        columns.append(cloud.normals.astype(cloud.points.dtype))
    npy.write_array(file, np.concatenate(columns, axis=1), allow_pickle=False)
