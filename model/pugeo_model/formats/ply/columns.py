# SPDX-License-Identifier: Apache-2.0
"""Named columns of a file, such as the properties of PLY vertices, as parts of a cloud."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.colors import to_channels, unpack_rgb
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
_PACKED = ("rgb", "rgba")
_SPLAT = ("f_dc_", "f_rest_", "opacity", "scale_", "rot_")


class VertexColumns:
    """Arrays for the vertices of a file, to be filled by the reader of its body.

    Args:
        element: the ``vertex`` element. Its rows must be known to be in the file: arrays of
            ``element.count`` rows are allocated here.
        label: the format's name, for messages.

    Attributes:
        sinks: property name -> ``(count,)`` writable array or view. Properties that are not in
            it are not wanted.
        notes: sentences about everything that was dropped or guessed.

    Raises:
        MalformedFileError: no ``x``, ``y``, ``z``.
    """

    def __init__(self, element: Element, label: str = "PLY") -> None:
        types = {each.name: each.type for each in element.properties if each.count_type is None}
        missing = [name for name in _POINTS if name not in types]
        if missing:
            raise MalformedFileError(
                f"The {label} points have no column {', '.join(missing)}.",
                code="missing_property",
                missing=missing,
            )
        self._label = label
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
        colors = self._final_colors()
        return Cloud(self._points, self._normals, colors, self._scalars, tuple(self.notes))

    def _final_colors(self) -> NDArray[Any] | None:
        """Bring colours and alpha to 8 or 16 bits, or unpack them from one column."""
        if self._colors is None:
            for name in _PACKED:
                if name in self._scalars:
                    colors = unpack_rgb(self._scalars[name])
                    if colors is not None:
                        del self._scalars[name]
                        if self._label != "PCD":  # there it is the rule
                            note = f"Column {name!r} was unpacked into red, green, blue."
                            self.notes.append(note)
                        return colors
            return None
        channels, guessed = to_channels(self._colors)
        if guessed is not None:
            self.notes.append(guessed)
        if self._alpha is None:
            return channels
        alpha, _ = to_channels(self._alpha)
        if alpha.dtype == channels.dtype:
            return np.column_stack([channels, alpha])
        # 65535 / 255 = 257: the same share of the range in 16 bits.
        parts: list[NDArray[Any]] = [channels, alpha]
        wide = [p * np.uint16(257) if p.dtype == np.uint8 else p for p in parts]
        return np.column_stack(wide)
