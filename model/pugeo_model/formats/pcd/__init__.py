# SPDX-License-Identifier: Apache-2.0
"""PCD, the format of the Point Cloud Library: all three encodings read, binary written."""

from collections.abc import Iterator
from typing import IO

import numpy as np

from pugeo_model.cloud import Cloud
from pugeo_model.formats.limits import Declared, Limits
from pugeo_model.formats.pcd.encode import body, head
from pugeo_model.formats.pcd.fields import cloud_of
from pugeo_model.formats.pcd.header import read_header, sniff
from pugeo_model.formats.pcd.rows import read_columns
from pugeo_model.formats.ply.encode import rounded

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

NAME = "pcd"
EXTENSIONS: tuple[str, ...] = (".pcd",)
MEDIA_TYPES: tuple[str, ...] = ("application/x-pcd", "application/vnd.pcl.pcd")


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read the points of a PCD file.

    ``rgb`` and ``rgba`` are unpacked to colours, ``normal_x`` and its two fellows are normals,
    every other field is a scalar (``name_0``, ``name_1``, ... for a field of several values). The
    translation of ``VIEWPOINT`` is the sensor position; the default, zero, counts as one only in
    an organised cloud (``HEIGHT`` above 1), whose sensor is the origin. NaN points stay: cleaning
    drops them.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the declared points, ``max_header_bytes`` the header,
            ``max_bytes`` the size that compressed points unpack to.

    Raises:
        MalformedFileError: not PCD, truncated, no x y z, a value that makes no sense.
        LimitExceededError: larger than ``limits``.
    """
    header = read_header(file, limits)
    return cloud_of(header, read_columns(file, header, limits))


def declared(file: IO[bytes], limits: Limits) -> Declared:
    """Return the size of a cloud as the header states it.

    Args:
        file: seekable, at the first byte.
        limits: bounds of the header and of the number of points.

    Raises:
        MalformedFileError, LimitExceededError: as `read`.
    """
    header = read_header(file, limits)
    return Declared(header.points, header.row_bytes)


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write binary PCD: points and scalars in their own types, colours packed as ``rgb``."""
    file.write(head(cloud, len(cloud)))
    for block in rows(cloud):
        file.write(block)


def rows(cloud: Cloud) -> Iterator[bytes]:
    """The rows of some of the points."""
    return body(cloud)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    found = rounded(cloud)
    if cloud.colors is not None and cloud.colors.dtype == np.uint16:
        found.append("the lower 8 of 16 bits of colours")
    if cloud.colors is not None and cloud.colors.shape[1] == 4:
        found.append("alpha")
    if cloud.viewpoints is not None and len(cloud.viewpoints) > 1:
        found.append("all viewpoints but one")
    return found
