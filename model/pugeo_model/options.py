# SPDX-License-Identifier: Apache-2.0
"""Options of an upsampling run. Importing this module loads neither numba nor scipy."""

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any, NoReturn

from pugeo_model.errors import BadOptionError
from pugeo_model.orient.methods import METHODS

__all__ = ["DENSITIES", "LARGEST_RATIO", "Options", "Position", "refuse"]

Position = tuple[float, float, float]

LARGEST_RATIO = 32.0
"""Largest upsampling ratio."""

DENSITIES = ("even", "input")
"""Densities of the output: one spacing over the whole surface, or that of the input."""


@dataclass(frozen=True)
class Options:
    """Options of an upsampling run.

    Attributes:
        ratio: output points per input point, a real number in 1..32. At 1 the output is the
            input points with normals.
        n_points: number of output points; replaces the ratio.
        orient: method that gives normals their signs: ``auto``, ``input``, ``viewpoint``,
            ``mst``, ``outward`` or ``none``.
        viewpoint: sensor position ``(x, y, z)`` in the cloud's own frame and units, or several
            such positions.
        seed: 0..2^63-1; each seed gives another, equally even sample.
        keep_input: the output begins with the cleaned input points, unchanged and in their
            order; new points are distributed between them. Otherwise noise is removed, and clean
            input points are kept only where they fit into an even distribution.
        density: ``input``, the density of the output follows that of the input; ``even``, one
            spacing over the whole surface.
        spacing: mean distance of neighbouring output points, in the cloud's units; replaces the
            ratio and means density ``even``.
        max_gap: largest distance of an output point from the input, in the cloud's units; by
            default 1.25 local spacings.
        denoise: with ratio 1, move the input points onto the surface; they keep their order and
            attributes.
        confidence: add the scalar ``expected_error`` to the output, the distance from the true
            surface that is expected of each point, in the cloud's units.

    Raises:
        BadOptionError: a value is out of range; its ``fields`` hold the name and the value.
    """

    ratio: float = 4.0
    n_points: int | None = None
    orient: str = "auto"
    viewpoint: Position | tuple[Position, ...] | None = None
    seed: int = 0
    keep_input: bool = False
    density: str = "input"
    spacing: float | None = None
    max_gap: float | None = None
    denoise: bool = False
    confidence: bool = False

    def __post_init__(self) -> None:
        for name in ("ratio", "n_points", "seed", "spacing", "max_gap"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, Real):
                refuse(name, value, "a number")
        if not 1.0 <= self.ratio <= LARGEST_RATIO:
            refuse("ratio", self.ratio, "a number from 1 to 32", limit=[1, 32])
        if self.n_points is not None and self.n_points < 1:
            refuse("n_points", self.n_points, "a positive whole number")
        if self.orient not in METHODS:
            refuse("orient", self.orient, f"one of {', '.join(METHODS)}", allowed=list(METHODS))
        self._check_viewpoints()
        if self.orient == "viewpoint" and not self.viewpoints:
            refuse("viewpoint", None, "given where orient is 'viewpoint'")
        if not 0 <= self.seed < 2**63:
            refuse("seed", self.seed, "a whole number from 0 to 2^63 - 1")
        if self.density not in DENSITIES:
            refuse("density", self.density, "even or input", allowed=list(DENSITIES))
        for name in ("spacing", "max_gap"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                refuse(name, value, "a positive number, in the units of the cloud")
        self._check_combinations()

    def _check_viewpoints(self) -> None:
        """Refuse positions that are not three finite numbers each."""
        try:
            good = all(math.isfinite(value) for at in self.viewpoints for value in at)
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good:
            refuse("viewpoint", self.viewpoint, "three finite numbers x, y, z")

    def _check_combinations(self) -> None:
        """Refuse options that contradict each other."""
        if self.spacing is not None and self.n_points is not None:
            refuse("spacing", self.spacing, "given without n_points")
        if self.spacing is not None and self.keep_input:
            refuse("spacing", self.spacing, "given without keep_input, whose points have their own")
        if self.denoise and (self.keep_input or self.n_points or self.spacing or self.ratio != 1.0):
            refuse(
                "denoise",
                self.denoise,
                "used with ratio 1 and without keep_input; other ratios remove noise by themselves",
            )

    @property
    def viewpoints(self) -> tuple[Position, ...]:
        """All sensor positions, as floats."""
        if self.viewpoint is None:
            return ()
        positions: Any = tuple(self.viewpoint)
        if positions and isinstance(positions[0], Real):
            positions = (positions,)
        return tuple((float(x), float(y), float(z)) for x, y, z in positions)

    @property
    def is_even(self) -> bool:
        """True if the output has one spacing over the whole surface."""
        return self.density == "even" or self.spacing is not None

    def points_out(self, count: int) -> int | None:
        """Return the number of output points for ``M`` input points: round(R M), halves up.

        ``None`` with ``spacing``: the number then follows from the area of the surface.
        """
        if self.spacing is not None:
            return None
        return self.n_points or math.floor(self.ratio * count + 0.5)

    def keeps_points(self, count: int) -> bool:
        """Return whether the output has the input points, in order: by option, or at ratio 1."""
        return self.keep_input or self.points_out(count) == count


def refuse(name: str, value: Any, expected: str, **fields: Any) -> NoReturn:
    """Raise a `BadOptionError` that names the option, its value and the expected range."""
    raise BadOptionError(
        f"{name} must be {expected}, not {value!r}", parameter=name, value=value, **fields
    )
