# SPDX-License-Identifier: Apache-2.0
"""Requests whose right answer is known: spheres, counted and measured."""

import hashlib
import io
import math
from dataclasses import dataclass, field

import numpy as np

from pugeo_client._result import Meta, Result
from pugeo_client.errors import InvalidResponseError
from pugeo_model import Cloud, formats

__all__ = ["REACH", "Ask", "Book", "ask"]

# How far a point may be from the true sphere, in mean spacings of the input: three times what
# was the worst of many when this was written.
REACH = 0.1
_UNIT = 1e-3


@dataclass(frozen=True)
class Ask:
    """One request that can be sent any number of times.

    Attributes:
        points: points in.
        ratio: points out for each point in.
        seed: of the placement.
        body: a binary PLY file.
    """

    points: int
    ratio: float
    seed: int
    body: bytes = field(repr=False)

    @property
    def name(self) -> str:
        """Such as ``2,000 x2 seed 0``."""
        return f"{self.points:,} x{self.ratio:g} seed {self.seed}"

    @property
    def query(self) -> dict[str, str]:
        """Options of the request."""
        return {"R": repr(self.ratio), "seed": str(self.seed), "format": "ply"}

    @property
    def points_out(self) -> int:
        """Points that the answer must have: ``R * M``, halves up."""
        return math.floor(self.ratio * self.points + 0.5)


def ask(points: int, ratio: float = 2.0, seed: int = 0) -> Ask:
    """Ask for more points on a unit sphere sampled at random."""
    directions = np.random.default_rng(points).normal(size=(points, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return Ask(points, ratio, seed, buffer.getvalue())


@dataclass
class Book:
    """Answers so far: the first one to a request is measured, later ones must be the same bytes.

    Attributes:
        right: answers that were right.
        wrong: what was wrong with the others.
        furthest: largest distance from the true sphere met, in mean spacings of the input.
    """

    right: int = 0
    wrong: list[str] = field(default_factory=list)
    furthest: float = 0.0
    _digests: dict[str, str] = field(default_factory=dict)

    def check(self, asked: Ask, answer: bytes) -> bool:
        """Enter an answer; return whether it is right."""
        digest = hashlib.sha256(answer).hexdigest()
        known = self._digests.get(asked.name)
        fault = self._measure(asked, answer) if known is None else None
        if known is not None and digest != known:
            fault = "other bytes than the same request had before"
        if fault is not None:
            self.wrong.append(f"{asked.name}: {fault}")
            return False
        self._digests[asked.name] = digest
        self.right += 1
        return True

    def _measure(self, asked: Ask, answer: bytes) -> str | None:
        result = Result(Meta(), format="ply", data=answer)
        try:
            points, normals = result.points.astype(np.float64), result.normals
        except InvalidResponseError as error:
            return f"no PLY: {error}"
        if len(points) != asked.points_out:
            return f"{len(points):,} points, not {asked.points_out:,}"
        if normals is None or np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() > _UNIT:
            return "normals are missing or not of unit length"
        spacing = math.sqrt(4.0 * math.pi / asked.points)
        off = float(np.abs(np.linalg.norm(points, axis=1) - 1.0).max()) / spacing
        self.furthest = max(self.furthest, off)
        return None if off <= REACH else f"a point is {off:.2f} spacings off the sphere"
