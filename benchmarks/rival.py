# SPDX-License-Identifier: Apache-2.0
"""Upsampling without learning, as one would write it in an afternoon from library parts.

A k-d tree gives every point 16 neighbours, PCA a tangent plane, weighted least squares a quadric
over it (a moving least squares surface of order two). Each point then throws R random samples on
its own share of the plane and lifts them onto its quadric.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["upsample"]

Floats = NDArray[np.float64]

_NEIGHBOURS = 16
_BLOCK = 20_000  # points at a time, so that memory stays bounded
_RIDGE = 1e-9  # keeps the fit solvable where neighbours lie on a line


def upsample(points: Floats, ratio: int, seed: int = 0) -> tuple[Floats, Floats]:
    """``ratio`` samples around every point.

    Args:
        points: ``(M, 3)``.
        ratio: samples a point.
        seed: of the samples.

    Returns:
        Points ``(M * ratio, 3)`` and unit normals of any sign, ``(M * ratio, 3)``.
    """
    rng = np.random.default_rng(seed)
    far, near = map(np.asarray, cKDTree(points).query(points, _NEIGHBOURS + 1))
    spacing = far[:, 1:9].mean(axis=1)
    blocks = []
    for start in range(0, len(points), _BLOCK):
        part = slice(start, start + _BLOCK)
        blocks.append(_block(points[near[part]], points[part], spacing[part], ratio, rng))
    dense, normals = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
    return dense, normals


def _block(
    around: Floats, points: Floats, spacing: Floats, ratio: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Samples around ``n`` points with neighbours ``(n, k, 3)``."""
    offsets = (around - points[:, None]) / spacing[:, None, None]
    centred = offsets - offsets.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    axes = vectors[:, :, ::-1].transpose(0, 2, 1)  # rows: two tangents, then the normal
    local = np.einsum("nai,nki->nka", axes, offsets)
    u, v, height = np.moveaxis(local, -1, 0)
    weight = np.exp(-(local**2).sum(axis=-1) / 4.0)
    terms = _terms(u, v)
    gram = np.einsum("nk,nka,nkb->nab", weight, terms, terms) + _RIDGE * np.eye(6)
    right = np.einsum("nk,nka,nk->na", weight, terms, height)
    fit = np.linalg.solve(gram, right[..., None])[..., 0]

    turn = rng.uniform(0.0, 2.0 * np.pi, (len(points), ratio))
    reach = 0.49 * np.sqrt(rng.random((len(points), ratio)))  # the disk of a point's share
    u, v = reach * np.cos(turn), reach * np.sin(turn)
    height = np.einsum("nra,na->nr", _terms(u, v), fit)
    slope_u = fit[:, 1, None] + 2.0 * fit[:, 3, None] * u + fit[:, 4, None] * v
    slope_v = fit[:, 2, None] + fit[:, 4, None] * u + 2.0 * fit[:, 5, None] * v
    normals = np.stack([-slope_u, -slope_v, np.ones_like(u)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lifted = np.stack([u, v, height], axis=-1) * spacing[:, None, None]
    dense = points[:, None] + lifted @ axes
    return dense.reshape(-1, 3), (normals @ axes).reshape(-1, 3)


def _terms(u: Floats, v: Floats) -> Floats:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
