# SPDX-License-Identifier: Apache-2.0
"""Limits of an input, checked before anything is allocated for it."""

from dataclasses import dataclass

from pugeo_model.errors import LimitExceededError

__all__ = ["DEFAULT_LIMITS", "Limits"]


@dataclass(frozen=True)
class Limits:
    """Bounds that every reader checks against what a file *declares*, before it allocates.

    Attributes:
        max_points: points of a cloud.
        max_header_bytes: bytes of a PLY header, and of a zip archive's directory.
        max_header_lines: lines of a PLY header.
        max_bytes: bytes of a file, and of the arrays that an archive unpacks to.
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


DEFAULT_LIMITS = Limits()
