# SPDX-License-Identifier: Apache-2.0
"""Markdown tables of measured columns."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pugeo_model.metrics.evaluation import COLUMNS

__all__ = ["legend", "table"]


class _Column(NamedTuple):
    heading: str
    decimals: int
    meaning: str


_COLUMNS = {
    "CD": _Column("CD", 4, "half the sum of both mean nearest distances to the reference, 1e-2"),
    "HD": _Column("HD", 3, "the larger of both largest nearest distances, 1e-2"),
    "JSD": _Column("JSD", 3, "divergence of the occupancy of a 28^3 grid, 1e-2"),
    "P2F": _Column("P2F", 3, "mean distance to the true surface, 1e-3"),
    "P2F_std": _Column("P2F std", 3, "standard deviation of these distances, 1e-3"),
    "sCD": _Column("sCD", 4, "sum of both mean squared distances at radius 1, 1e-3"),
    "sHD": _Column("sHD", 3, "sum of both largest squared distances at radius 1, 1e-3"),
    "normal_mean": _Column("normals", 2, "mean angle to the true normal, sign ignored, degrees"),
    "normal_rms": _Column("normals RMS", 2, "root of the mean squared angle, degrees"),
    "normal_below_10": _Column("below 10°", 1, "normals with a smaller angle, percent"),
    "outward": _Column("outward", 1, "normals with the true sign, percent"),
    "evenness": _Column("evenness", 3, "variation of nearest-neighbour distances"),
    "CD#": _Column("CD#", 4, "CD of 200,000 points of reconstructed and true surface, 1e-2"),
    "HD#": _Column("HD#", 3, "HD of these points, 1e-2"),
    "JSD#": _Column("JSD#", 3, "JSD of these points, 1e-2"),
    "stray": _Column("stray", 2, "points further than 1 % of the size from the surface, percent"),
    "density": _Column("density", 3, "variation of the number of points within 4 spacings"),
    "left": _Column("left", 3, "share of the noisy input's squared distances that is left"),
}
assert tuple(_COLUMNS) == COLUMNS


def legend(rows: Iterable[Mapping[str, float]]) -> str:
    """Return the meanings of the columns that rows have, as a Markdown list."""
    shown = _shown(rows)
    return "\n".join(f"- {_COLUMNS[name].heading}: {_COLUMNS[name].meaning}" for name in shown)


def table(
    rows: Iterable[tuple[tuple[str, ...], Mapping[str, float]]], labels: tuple[str, ...]
) -> str:
    """Format rows as a Markdown table; columns that no row has are omitted.

    Args:
        rows: cells of the leading columns, and measured columns, of each row.
        labels: headings of the leading columns.
    """
    rows = list(rows)
    shown = _shown(row for _, row in rows)
    lines = [
        [*labels, *(_COLUMNS[name].heading for name in shown)],
        ["---"] * len(labels) + ["---:"] * len(shown),
        *(
            [*lead, *(f"{row[n]:.{_COLUMNS[n].decimals}f}" if n in row else "" for n in shown)]
            for lead, row in rows
        ),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _shown(rows: Iterable[Mapping[str, float]]) -> list[str]:
    """Columns that any row has, in their usual order."""
    found = {name for row in rows for name in row}
    return [name for name in COLUMNS if name in found]
