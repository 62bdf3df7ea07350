# SPDX-License-Identifier: Apache-2.0
"""Limits of an input, checked before anything is allocated for it, and of the notes on it."""

from collections.abc import Iterable
from dataclasses import dataclass

from pugeo_model.errors import LimitExceededError

__all__ = ["DEFAULT_LIMITS", "Declared", "Limits", "bounded_notes", "shortened"]

_MOST_NOTES = 50
_NOTE_CHARACTERS = 500


@dataclass(frozen=True)
class Limits:
    """Bounds that every reader checks against what a file *declares*, before it allocates.

    Attributes:
        max_points: points of a cloud.
        max_header_bytes: bytes of a PLY or PCD header, of a zip archive's directory, of the header
            of an array, and of the headers of all its arrays beyond the usual size of each.
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


def shortened(text: str, most: int) -> str:
    """Return a text of at most ``most`` characters; a longer one is cut and ends in three dots."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def bounded_notes(notes: Iterable[str]) -> tuple[str, ...]:
    """Bound the notes on a cloud in their number and in the length of each.

    A file decides how many properties a reader drops and how long their names are. Notes are shown
    to people and stored with results, so they must not grow with the file.

    Returns:
        At most 50 notes of at most 500 characters. If some are left out, the last one says how
        many. Notes that were bounded before stay as they are.
    """
    every = list(notes)
    kept = every if len(every) <= _MOST_NOTES else every[: _MOST_NOTES - 1]
    found = [shortened(note, _NOTE_CHARACTERS) for note in kept]
    if len(kept) < len(every):
        found.append(f"{len(every) - len(kept):,} more notes are left out.")
    return tuple(found)
