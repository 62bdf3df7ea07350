# SPDX-License-Identifier: Apache-2.0
"""What a caller may choose."""

import math
from dataclasses import dataclass
from typing import Any, NoReturn

from pugeo_model.errors import BadOptionError
from pugeo_model.orient.methods import METHODS

__all__ = ["MOST", "Options", "refuse"]

MOST = 32.0
"""Largest ratio."""


@dataclass(frozen=True)
class Options:
    """What the caller may choose.

    Attributes:
        ratio: output points an input point, a real number in 1..32. At 1 the input points come
            back, with normals.
        n_points: number of output points instead of a ratio.
        orient: ``auto``, ``input``, ``viewpoint``, ``mst``, ``outward`` or ``none``.
        viewpoint: sensor position in the cloud's own frame and units.
        seed: 0..2^63-1; other seeds give other, equally even samples.
        keep_input: the cleaned input points lead the answer, untouched and in their order, and
            the rest is spread among them. Else noise is smoothed away, and of a clean input those
            points stay that fit into an even spread.

    Raises:
        BadOptionError: a value out of range; its ``fields`` name it.
    """

    ratio: float = 4.0
    n_points: int | None = None
    orient: str = "auto"
    viewpoint: tuple[float, float, float] | None = None
    seed: int = 0
    keep_input: bool = False

    def __post_init__(self) -> None:
        if not 1.0 <= self.ratio <= MOST:
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
        """Output points for ``count`` input points: exactly round(R M), halves up."""
        return self.n_points or math.floor(self.ratio * count + 0.5)

    def keeps_points(self, count: int) -> bool:
        """Whether ``count`` input points begin the answer: asked for, or no point is new."""
        return self.keep_input or self.points_out(count) == count


def refuse(name: str, value: Any, wanted: str, **fields: Any) -> NoReturn:
    """Raise a `BadOptionError` that says what would be right."""
    raise BadOptionError(
        f"{name} must be {wanted}, not {value!r}", parameter=name, value=value, **fields
    )
