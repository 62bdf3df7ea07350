# SPDX-License-Identifier: Apache-2.0
"""A cloud as binary PCD 0.7: the header first, then rows in blocks."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats.colors import pack_rgb
from pugeo_model.formats.ply.encode import Column, columns

__all__ = ["body", "head"]

_BLOCK_ROWS = 16_384
_NORMALS = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
_CHANNELS = ("red", "green", "blue", "alpha")


def head(cloud: Cloud, count: int) -> bytes:
    """Bytes before the rows of ``count`` points with the attributes of ``cloud``."""
    fields = _fields(cloud)
    # The seven numbers are a position and a quaternion, which is 1 0 0 0 without a turn.
    place = "0 0 0"
    if cloud.viewpoints is not None and len(cloud.viewpoints) == 1:
        place = " ".join(f"{value:.17g}" for value in cloud.viewpoints[0])
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(each.name for each in fields)}",
        f"SIZE {' '.join(each.type[1] for each in fields)}",
        f"TYPE {' '.join(each.type[0].upper() for each in fields)}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        f"VIEWPOINT {place} 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
        "",
    ]
    return "\n".join(lines).encode()


def body(cloud: Cloud) -> Iterator[bytes]:
    """Yield the rows of a cloud, some thousand at a time."""
    fields = _fields(cloud)
    kind = np.dtype([(each.name, "<" + each.type) for each in fields])
    for start in range(0, len(cloud), _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, len(cloud))
        rows: NDArray[Any] = np.empty(stop - start, kind)
        for each in fields:
            rows[each.name] = each.values[start:stop]
        yield rows.tobytes()


def _fields(cloud: Cloud) -> list[Column]:
    """The columns of a PLY file, with PCL's names of normals and its packed colours."""
    found: list[Column] = []
    for each in columns(cloud):
        if cloud.colors is not None and each.name in _CHANNELS:
            if each.name == "red":
                found.append(Column("rgb", "f4", pack_rgb(cloud.colors)))
        else:
            found.append(Column(_NORMALS.get(each.name, each.name), each.type, each.values))
    return found
