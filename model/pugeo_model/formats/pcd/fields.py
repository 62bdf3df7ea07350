# SPDX-License-Identifier: Apache-2.0
"""Fields of a PCD file as parts of a cloud."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.formats.pcd.header import Header
from pugeo_model.formats.ply.columns import VertexColumns
from pugeo_model.formats.ply.header import Element, Property

__all__ = ["cloud_of"]


def cloud_of(header: Header, columns: dict[str, NDArray[Any]]) -> Cloud:
    """Build a cloud from the arrays of all fields."""
    single: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            single[name] = values
        else:
            for index, part in enumerate(values.T):
                single[f"{name}_{index}"] = np.ascontiguousarray(part)
    properties = tuple(Property(name, values.dtype.str[1:]) for name, values in single.items())
    vertices = VertexColumns(Element("vertex", header.points, properties), "PCD")
    # A value that float32 cannot hold becomes infinite: cleaning drops it, no warning needed.
    with np.errstate(over="ignore", invalid="ignore"):
        for name, sink in vertices.sinks.items():
            sink[:] = single[name]
    cloud = vertices.cloud()
    viewpoints = None
    if header.organised or any(header.viewpoint):
        viewpoints = np.array([header.viewpoint])
    return Cloud(
        cloud.points,
        cloud.normals,
        cloud.colors,
        cloud.scalars,
        cloud.notes,
        viewpoints=viewpoints,
        source=SourceInfo("pcd"),
    )
