# SPDX-License-Identifier: Apache-2.0
"""Options of an upsampling run. Importing this module loads neither numba nor scipy."""

import math
from dataclasses import dataclass
from typing import Any, NoReturn

from pugeo_model.errors import BadOptionError
from pugeo_model.orient.methods import METHODS

__all__ = ["LARGEST_RATIO", "Options", "refuse"]

LARGEST_RATIO = 32.0
"""Largest upsampling ratio."""


@dataclass(frozen=True)
class Options:
    """Options of an upsampling run.

    Attributes:
        ratio: output points per input point, a real number in 1..32. At 1 the output is the
            input points with normals.
        n_points: number of output points; replaces the ratio.
        orient: method that gives normals their signs: ``auto``, ``input``, ``viewpoint``,
            ``mst``, ``outward`` or ``none``.
        viewpoint: sensor position ``(x, y, z)`` in the cloud's own frame and units.
        seed: 0..2^63-1; each seed gives another, equally even sample.
        keep_input: the output begins with the cleaned input points, unchanged and in their
            order; new points are distributed between them. Otherwise noise is removed, and clean
            input points are kept only where they fit into an even distribution.

    Raises:
        BadOptionError: a value is out of range; its ``fields`` hold the name and the value.
    """

    ratio: float = 4.0
    n_points: int | None = None
    orient: str = "auto"
    viewpoint: tuple[float, float, float] | None = None
    seed: int = 0
    keep_input: bool = False

    def __post_init__(self) -> None:
        if not 1.0 <= self.ratio <= LARGEST_RATIO:
            refuse("ratio", self.ratio, "a number from 1 to 32", limit=[1, 32])
        if self.n_points is not None and self.n_points < 1:
            refuse("n_points", self.n_points, "a positive whole number")
        if self.orient not in METHODS:
            refuse("orient", self.orient, f"one of {', '.join(METHODS)}", allowed=list(METHODS))
        if self.viewpoint is not None and (not all(math.isfinite(v) for v in self.viewpoint)):
            refuse("viewpoint", list(self.viewpoint), "three finite numbers x, y, z")
        if self.orient == "viewpoint" and self.viewpoint is None:
            refuse("viewpoint", None, "given where orient is 'viewpoint'")
        if not 0 <= self.seed < 2**63:
            refuse("seed", self.seed, "a whole number from 0 to 2^63 - 1")

    def points_out(self, count: int) -> int:
        """Return the number of output points for ``M`` input points: round(R M), halves up."""
        return self.n_points or math.floor(self.ratio * count + 0.5)

    def keeps_points(self, count: int) -> bool:
        """Return whether the output begins with the input points: by option, or at ratio 1."""
        return self.keep_input or self.points_out(count) == count


def refuse(name: str, value: Any, expected: str, **fields: Any) -> NoReturn:
    """Raise a `BadOptionError` that names the option, its value and the expected range."""
    raise BadOptionError(
        f"{name} must be {expected}, not {value!r}", parameter=name, value=value, **fields
    )
