# SPDX-License-Identifier: Apache-2.0
"""Which side of the surface is outside.

The network's normals have no sign. Those of a file, a viewpoint and a centre are looked up here. A
tree over the input, which `orient` can grow where there is nothing else, is for clouds that were
not made denser: `by_answer` knows better where there is an answer.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import BadOptionError
from pugeo_model.orient.across_tiles import signs_across_tiles, tile_signs
from pugeo_model.orient.mst import relative_signs, row_dots

__all__ = ["METHODS", "orient", "resolve_method", "transfer_signs"]

METHODS = ("auto", "input", "viewpoint", "mst", "outward", "none")


def orient(
    points: NDArray[Any],
    normals: NDArray[Any],
    method: str,
    viewpoint: tuple[float, float, float] | NDArray[np.float64] | None,
    input_normals: NDArray[Any] | None,
    neighbours: NDArray[np.integer[Any]],
    centroid: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], str]:
    """Choose the signs of normals.

    The methods are

    - ``"input"``: as the file's own normals; where these are zero, as the neighbours.
    - ``"viewpoint"``: towards a point, such as the scanner's position.
    - ``"outward"``: away from the centroid; right for convex shapes.
    - ``"mst"``: neighbours agree, along a minimum spanning tree of the neighbour graph; each
      connected part as a whole outward, or upward where it is flat.
    - ``"none"``: as they are.
    - ``"auto"``: ``"input"`` if the file has normals, else ``"viewpoint"`` if one is given, else
      ``"mst"``.

    Args:
        points: ``(M, 3)`` float, the sparse input.
        normals: ``(M, 3)`` float, unit length, of any sign.
        method: one of ``METHODS``.
        viewpoint: in the frame of ``points``: one, or ``(M, 3)``, one for each point.
        input_normals: ``(M, 3)`` float, of any length, or ``None``.
        neighbours: ``(M, k)`` rows of ``points`` near each point. The point itself, and numbers
            outside ``0..M-1``, are skipped.
        centroid: ``(3,)`` that ``"outward"`` leads away from; by default that of ``points``.

    Returns:
        ``(M, 3)`` oriented normals of the same dtype, and the method used (never ``"auto"``).

    Raises:
        BadOptionError: an unknown method, or what it needs is missing or not finite.
    """
    method = resolve_method(method, viewpoint, has_normals=input_normals is not None)
    if method == "none" or not len(points):
        return normals, method
    if method == "input":
        assert input_normals is not None
        signs = _signs_of_input(normals, input_normals, neighbours)
    elif method == "viewpoint":
        assert viewpoint is not None
        signs = _signs(row_dots(normals, np.asarray(viewpoint, np.float64) - points))
    elif method == "outward":
        centre = points.mean(axis=0, dtype=np.float64) if centroid is None else centroid
        signs = _signs(row_dots(normals, points - centre))
    else:
        signs = _signs_of_tree(points, normals, neighbours)
    return _flip(normals, signs), method


def resolve_method(
    method: str,
    viewpoint: tuple[float, float, float] | NDArray[np.float64] | None,
    *,
    has_normals: bool,
) -> str:
    """Return the method that will be used: what ``"auto"`` stands for, or ``method`` itself.

    Raises:
        BadOptionError: as `orient`.
    """
    if method not in METHODS:
        raise BadOptionError(
            f"orient={method!r} is unknown; it can be {', '.join(METHODS)}.",
            name="orient",
            value=method,
            allowed=list(METHODS),
        )
    if viewpoint is not None and not np.isfinite(viewpoint).all():
        raise BadOptionError("viewpoint must be three finite numbers.", name="viewpoint")
    if method == "auto":
        given = "viewpoint" if viewpoint is not None else "mst"
        return "input" if has_normals else given
    if method == "input" and not has_normals:
        raise BadOptionError("orient='input' needs a file with usable normals.", name="orient")
    if method == "viewpoint" and viewpoint is None:
        raise BadOptionError("orient='viewpoint' needs a viewpoint.", name="viewpoint")
    return method


def transfer_signs(
    normals: NDArray[Any], nearest: NDArray[np.integer[Any]], oriented: NDArray[Any]
) -> NDArray[Any]:
    """Give each dense normal the sign of the sparse normal nearest to it.

    Args:
        normals: ``(K, 3)`` float, of any sign.
        nearest: ``(K,)`` row of the sparse point nearest to each dense point.
        oriented: ``(M, 3)`` float, as `orient` returns them.

    Returns:
        ``(K, 3)`` of the dtype of ``normals``.
    """
    signs = _signs(row_dots(normals, oriented[nearest]))
    return _flip(normals, signs)


def _flip(normals: NDArray[Any], signs: NDArray[np.float64]) -> NDArray[Any]:
    flipped: NDArray[Any] = normals * signs[:, None].astype(normals.dtype)
    return flipped


def _signs(values: NDArray[Any]) -> NDArray[np.float64]:
    """-1 or 1, never 0."""
    return np.where(values < 0, -1.0, 1.0)


def _signs_of_input(
    normals: NDArray[Any], given: NDArray[Any], neighbours: NDArray[np.integer[Any]]
) -> NDArray[np.float64]:
    agreement = row_dots(normals, given)
    signs = _signs(agreement)
    unknown = np.flatnonzero(agreement == 0)
    if len(unknown):
        near = neighbours[unknown]
        there = (near >= 0) & (near < len(normals))
        near = np.where(there, near, 0)
        # Neighbours without a sign of their own have no vote.
        votes = np.sign(agreement)[near] * there
        cosines = np.einsum("ij,ikj->ik", normals[unknown], normals[near])
        signs[unknown] = _signs((votes * cosines).sum(axis=1))
    return signs


def _signs_of_tree(
    points: NDArray[Any], normals: NDArray[Any], neighbours: NDArray[np.integer[Any]]
) -> NDArray[np.float64]:
    # Float64 and near the origin: products of coordinates follow.
    points = points - points.mean(axis=0, dtype=np.float64)
    signs, parts = relative_signs(points, normals, neighbours)
    rows, core = np.arange(len(points), dtype=np.int32), np.ones(len(points), dtype=np.bool_)
    sides = tile_signs(rows, core, points, normals, signs, parts, neighbours)
    return signs * signs_across_tiles([sides])[0][parts]
