# SPDX-License-Identifier: Apache-2.0
"""Conversion of arrays, lists, tensors and Open3D clouds into the NPZ that the service reads.

Tensors and clouds are recognised by their attributes, so that no library is imported for them.
"""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_client._npz import write_npz
from pugeo_client.errors import SourceError

__all__ = ["pack_npz", "to_cloud_arrays"]

_ARRAYS = ("points", "normals", "colors")
_OPEN3D_NAMES = {"positions": "points", "normals": "normals", "colors": "colors"}
_XYZ = 3


def to_cloud_arrays(source: Any) -> dict[str, Any]:
    """Split a source in memory into arrays ``points``, ``normals``, ``colors`` and ``scalars``.

    Args:
        source: a mapping with these names, an Open3D cloud (legacy or tensor), or an ``(N, 3)``
            or ``(N, 6)`` array, list or tensor.

    Raises:
        SourceError: it is something else.
    """
    if isinstance(source, Mapping):
        unknown = set(source) - {*_ARRAYS, "scalars"}
        if unknown or source.get("points") is None:
            raise SourceError(
                f"a dict of arrays has points, normals, colors, scalars; not {_names(source)}"
            )
        return dict(source)
    if hasattr(source, "point") and hasattr(source.point, "items"):
        return _from_open3d_tensors(source.point)
    if hasattr(source, "has_points") and hasattr(source, "points"):
        return _from_open3d(source)
    array = _to_array("points", source)
    if array.dtype.kind not in "fiub" or array.ndim != 2:
        raise SourceError(
            f"cannot send a {type(source).__name__}: give a path, bytes, an open binary file, an "
            "(N, 3) or (N, 6) array, list or tensor, an Open3D cloud, or a dict with points"
        )
    if array.shape[1] == 2 * _XYZ:
        return {"points": array[:, :_XYZ], "normals": array[:, _XYZ:]}
    return {"points": array}


def pack_npz(arrays: Mapping[str, Any]) -> bytes:
    """Pack arrays as the NPZ that the service reads.

    Args:
        arrays: ``points`` ``(N, 3)``, and optionally ``normals``, ``colors`` and a dict
            ``scalars`` of ``(N,)``. None counts as missing.

    Raises:
        SourceError: an array has another number of rows, or no numbers.
    """
    scalars = arrays.get("scalars") or {}
    if not isinstance(scalars, Mapping):
        raise SourceError(f"scalars must be a dict of arrays, not {type(scalars).__name__}")
    named = {name: arrays[name] for name in _ARRAYS if arrays.get(name) is not None}
    clashing = [name for name in scalars if name in _ARRAYS or not isinstance(name, str)]
    if clashing:
        raise SourceError(f"scalars cannot be called {_names(clashing)}")
    named |= scalars
    packed = {name: _to_array(name, values) for name, values in named.items()}
    points = packed["points"]
    if points.ndim != 2 or points.shape[1] != _XYZ:
        raise SourceError(f"points must be (N, 3) or (N, 6), not {points.shape}")
    for name, array in packed.items():
        if array.dtype.kind not in "fiub" or array.shape[:1] != points.shape[:1]:
            raise SourceError(
                f"{name} must be {len(points)} rows of numbers, not {array.dtype} {array.shape}"
            )
    if points.dtype not in (np.float32, np.float64):
        packed["points"] = points.astype(np.float64)
    file = io.BytesIO()
    write_npz(file, packed)
    return file.getvalue()


def _from_open3d(cloud: Any) -> dict[str, Any]:
    """Read an ``open3d.geometry.PointCloud``; its colours are floats from 0 to 1."""
    arrays = {name: _to_array(name, getattr(cloud, name)) for name in _ARRAYS}
    found = {name: array for name, array in arrays.items() if len(array) or name == "points"}
    return _with_bytes_of_colors(found)


def _from_open3d_tensors(attributes: Any) -> dict[str, Any]:
    """Read the attributes of an ``open3d.t.geometry.PointCloud``: one column each is a scalar."""
    arrays: dict[str, Any] = {}
    scalars: dict[str, NDArray[Any]] = {}
    for name, tensor in attributes.items():
        array = _to_array(name, tensor)
        if name in _OPEN3D_NAMES:
            arrays[_OPEN3D_NAMES[name]] = array
        elif array.ndim == 1 or array.shape[1:] == (1,):
            scalars[name] = array.reshape(-1)
        else:
            raise SourceError(f"the attribute {name} of the cloud is {array.shape}, not (N, 1)")
    if "points" not in arrays:
        raise SourceError("the cloud has no positions")
    return _with_bytes_of_colors(arrays) | {"scalars": scalars}


def _with_bytes_of_colors(arrays: dict[str, Any]) -> dict[str, Any]:
    colors = arrays.get("colors")
    if colors is not None and colors.dtype.kind == "f":
        arrays["colors"] = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    return arrays


def _to_array(name: str, values: Any) -> NDArray[Any]:
    """Convert to numpy, from any device and without a gradient."""
    try:
        for method in ("detach", "cpu", "numpy"):  # torch has all three, Open3D the last two
            if callable(getattr(values, method, None)):
                values = getattr(values, method)()
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise SourceError(f"{name} cannot be made an array: {error}") from error


def _names(names: Any) -> str:
    return ", ".join(sorted(str(name) for name in names)) or "nothing"
