# SPDX-License-Identifier: Apache-2.0
"""Normals that came with a cloud: which of them can be used, and whether their signs agree."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud

__all__ = ["signs_agree", "usable_normals"]

_SAMPLED = 1000  # points whose normals are compared with those of their neighbours
_NEIGHBOURS = 6
_OPPOSED = 0.25
"""Share of opposed neighbours above which signs count as random (that gives 0.5). Thin walls and
sharp edges of scans with right signs stay below 0.1."""


def usable_normals(cloud: Cloud) -> Cloud:
    """Keep the normals that can be used; the others become zero, which stands for unknown.

    All normals are left out, with a note, where more than half are not finite or zero (Gaussian
    splat files have zeros only), or where they look like colours in 0..255.

    Args:
        cloud: cleaned.
    """
    if cloud.normals is None or not len(cloud):
        return cloud
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(cloud.normals, axis=1)
    good = np.isfinite(lengths) & (lengths > 0)
    bad = len(cloud) - int(np.count_nonzero(good))
    normals: NDArray[np.float32] | None = cloud.normals
    note = None
    if bad == len(cloud) and not cloud.normals.any():
        normals, note = None, "The normals are left out: all are zero."
    elif 2 * bad > len(cloud):
        normals = None
        note = f"The normals are left out: {bad:,} of {len(cloud):,} are zero or not finite."
    elif _are_colors(cloud.normals):
        normals = None
        note = (
            "The normals are left out: they are whole numbers in 0..255, as colours are. Give "
            "colours as colours."
        )
    elif bad:
        if not np.isfinite(cloud.normals).all():
            normals = np.where(good[:, None], cloud.normals, np.float32(0.0))
        note = (
            f"{bad:,} of {len(cloud):,} normals are zero or not finite; neighbours decide their "
            "signs."
        )
    else:
        return cloud
    return replace(cloud, normals=normals, notes=(*cloud.notes, note))


def _are_colors(normals: NDArray[np.float32]) -> bool:
    in_range = (normals >= 0) & (normals <= 255) & (normals == np.rint(normals))
    return bool(in_range.all() and normals.max() > 1)


def signs_agree(cloud: Cloud) -> bool:
    """True if the signs of neighbouring normals agree, as those of one surface do.

    Most estimators give axes of random sign. Of a sample of points, the six nearest neighbours
    are asked for the sign of the product of normals, as far as both axes are within 60 degrees.

    Args:
        cloud: cleaned, with normals.
    """
    assert cloud.normals is not None
    count = len(cloud)
    if count <= _NEIGHBOURS:
        return True
    rows = np.linspace(0, count - 1, min(count, _SAMPLED)).astype(np.int64)
    # Sparse coordinates only matter relative to each other; far from the origin they need it.
    points = cloud.points.astype(np.float64)
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    near = np.asarray(tree.query(points[rows], k=_NEIGHBOURS + 1)[1])[:, 1:]
    normals = cloud.normals.astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.where(lengths > 0, lengths, 1.0)[:, None]
    cosines = np.einsum("ni,nki->nk", normals[rows], normals[near])
    close = np.abs(cosines) > 0.5
    pairs = int(np.count_nonzero(close))
    return pairs == 0 or int(np.count_nonzero(cosines[close] < 0)) <= _OPPOSED * pairs
