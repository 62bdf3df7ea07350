# SPDX-License-Identifier: Apache-2.0
"""Limits of an input, checked before anything is allocated for it."""

from dataclasses import dataclass

from pugeo_model.errors import LimitExceededError

__all__ = ["DEFAULT_LIMITS", "Declared", "Limits"]


@dataclass(frozen=True)
class Limits:
    """Bounds that every reader checks against what a file *declares*, before it allocates.

    Attributes:
        max_points: points of a cloud.
        max_header_bytes: bytes of a PLY or PCD header, of a zip archive's directory, and of the
            header of an array.
        max_header_lines: lines of a PLY header.
        max_bytes: bytes of a file, and of the points with all attributes that it unpacks to.
    """

    max_points: int = 20_000_000
    max_header_bytes: int = 65_536
    max_header_lines: int = 1_000
    max_bytes: int = 2_147_483_648

    def check(self, name: str, value: int, what: str) -> None:
        """Refuse a value above the limit called ``name``.

        Raises:
            LimitExceededError: with ``name``, ``limit`` and ``value``.
        """
        limit: int = getattr(self, name)
        if value > limit:
            raise LimitExceededError(
                f"{what}: {value:,} is more than the limit of {limit:,}.",
                name=name,
                limit=limit,
                value=value,
            )


@dataclass(frozen=True)
class Declared:
    """Size of a cloud as the header of its file states it.

    Attributes:
        points: number of points.
        row_bytes: bytes of a point with its attributes.
    """

    points: int
    row_bytes: int

    def check(self, limits: Limits) -> None:
        """Refuse a cloud that is larger than the limits.

        Raises:
            LimitExceededError: more points, or more bytes once unpacked.
        """
        limits.check("max_points", self.points, "Points of the cloud")
        limits.check(
            "max_bytes", self.points * self.row_bytes, "Bytes of the points with all attributes"
        )


DEFAULT_LIMITS = Limits()
