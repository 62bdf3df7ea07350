# SPDX-License-Identifier: Apache-2.0
"""Which property of a PLY vertex becomes what of a cloud."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.colors import to_uint8
from pugeo_model.formats.ply.header import Element

__all__ = ["VertexColumns"]

_POINTS = ("x", "y", "z")
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_COLORS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_ALPHAS = (("alpha",), ("diffuse_alpha", "alpha"), ("a", "alpha"))
_SPLAT = ("f_dc_", "f_rest_", "opacity", "scale_", "rot_")


class VertexColumns:
    """Arrays for the vertices of a file, to be filled by whoever reads its body.

    Args:
        element: the ``vertex`` element. Its rows must be known to be in the file: arrays of
            ``element.count`` rows are allocated here.

    Attributes:
        sinks: property name -> ``(count,)`` writable array or view. Properties that are not in
            it are not wanted.
        notes: what was dropped or guessed.

    Raises:
        MalformedFileError: no ``x``, ``y``, ``z``.
    """

    def __init__(self, element: Element) -> None:
        types = {each.name: each.type for each in element.properties if each.count_type is None}
        missing = [name for name in _POINTS if name not in types]
        if missing:
            raise MalformedFileError(
                f"The PLY vertices have no property {', '.join(missing)}.",
                code="missing_property",
                missing=missing,
            )
        self.notes: list[str] = []
        self.sinks: dict[str, NDArray[Any]] = {}
        count = element.count

        exact = any(types[name] != "f4" for name in _POINTS)
        self._points = np.empty((count, 3), np.float64 if exact else np.float32)
        self.sinks.update(zip(_POINTS, self._points.T, strict=True))

        self._normals: NDArray[np.float32] | None = None
        names = next((each for each in _NORMALS if all(name in types for name in each)), None)
        if names is not None:
            self._normals = np.empty((count, 3), np.float32)
            self.sinks.update(zip(names, self._normals.T, strict=True))

        self._colors: NDArray[Any] | None = None
        self._alpha: NDArray[Any] | None = None
        for rgb, alphas in zip(_COLORS, _ALPHAS, strict=True):
            if all(name in types for name in rgb):
                common = np.result_type(*(types[name] for name in rgb))
                self._colors = np.empty((count, 3), common)
                self.sinks.update(zip(rgb, self._colors.T, strict=True))
                alpha = next((name for name in alphas if name in types), None)
                if alpha is not None:
                    self._alpha = self.sinks[alpha] = np.empty(count, types[alpha])
                break

        splat = "f_dc_0" in types and ("opacity" in types or "scale_0" in types)
        self._scalars: dict[str, NDArray[Any]] = {}
        for name, kind in types.items():
            if name not in self.sinks and not (splat and name.startswith(_SPLAT)):
                self._scalars[name] = self.sinks[name] = np.empty(count, kind)

        if splat:
            self.notes.append(
                "This is a Gaussian splat file: only its positions and normals are treated, "
                "the splats' own parameters are dropped."
            )
        lists = [each.name for each in element.properties if each.count_type is not None]
        if lists:
            self.notes.append(f"List properties of the vertices are dropped: {', '.join(lists)}.")

    def cloud(self) -> Cloud:
        """Build the cloud, once all sinks are filled."""
        colors: NDArray[np.uint8] | None = None
        if self._colors is not None:
            colors, note = to_uint8(self._colors)
            if note is not None:
                self.notes.append(note)
            if self._alpha is not None:
                alpha, _ = to_uint8(self._alpha)
                colors = np.column_stack([colors, alpha])
        return Cloud(self._points, self._normals, colors, self._scalars, tuple(self.notes))
