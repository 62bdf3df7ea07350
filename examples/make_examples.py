# SPDX-License-Identifier: Apache-2.0
"""Make the example clouds of this folder from shapes that are a few formulas each.

    python examples/make_examples.py

Both have what upsampling is judged by: curvature that changes, sharp edges, and sheets that pass
close by each other. They transfer_attributes colours and no normals, as a scan does.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_model import Cloud
from pugeo_model.formats import write

Floats = NDArray[np.float64]
HERE = Path(__file__).parent
CANDIDATES_PER_POINT = 12


def twisted_knot(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Sample a trefoil knot whose tube is square and turns three quarters on its way round.

    Returns:
        points ``(count, 3)`` and colours ``(count, 3)`` in [0, 1].
    """
    along = np.linspace(0, 2 * np.pi, 1801)
    around = np.linspace(0, 1, 129)
    centre, side, up = _trefoil_frame(along)
    turn = 0.75 * along  # a square closes upon itself after quarter turns
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    across, upward = cosine * side + sine * up, cosine * up - sine * side
    square = 0.52 * _unit_square(around)
    grid = centre[:, None] + square[:, :1] * across[:, None] + square[:, 1:] * upward[:, None]
    points, where = _sample_grid(rng, grid, count * CANDIDATES_PER_POINT)
    kept = _spread(points, count)
    phase = where[kept, 0] * 3  # the palette passes once through each of the three lobes
    return points[kept], _palette(phase)


def cut_block(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Sample a block with a hole bored through it and a ball cut out of one corner.

    Returns:
        points ``(count, 3)`` and colours ``(count, 3)`` in [0, 1].
    """
    hole, bore, ball = np.array([-0.3, -0.3]), 0.42, 1.15
    drawn = 60 * count
    faces = rng.uniform(-1, 1, (drawn, 3))
    faces[np.arange(drawn), rng.integers(0, 3, drawn)] = rng.choice([-1.0, 1.0], drawn)
    share = drawn / 24  # samples per unit of area: a block of side 2 has 24
    turn = rng.uniform(0, 2 * np.pi, int(share * 4 * np.pi * bore))
    height = rng.uniform(-1, 1, len(turn))
    wall = np.stack([hole[0] + bore * np.cos(turn), hole[1] + bore * np.sin(turn), height], axis=1)
    dent = rng.normal(size=(int(share * 4 * np.pi * ball**2), 3))
    dent = 1 - ball * np.abs(dent) / np.linalg.norm(dent, axis=1, keepdims=True)
    dent = dent[rng.random(len(dent)) < 1 / 8]  # `abs` folded the whole sphere onto one octant

    def beside_hole(points: Floats) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(points[:, :2] - hole, axis=1) >= bore - 1e-9)

    def outside_ball(points: Floats) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(points - 1, axis=1) >= ball - 1e-9)

    faces = faces[beside_hole(faces) & outside_ball(faces)]
    wall = wall[outside_ball(wall)]
    dent = dent[beside_hole(dent) & np.all(np.abs(dent) <= 1, axis=1)]
    parts = [faces, wall, dent]
    kind = np.repeat([0.05, 0.45, 0.75], [len(part) for part in parts])
    points = np.concatenate(parts)
    few = rng.permutation(len(points))[: count * CANDIDATES_PER_POINT]
    points, kind = points[few], kind[few]
    kept = _spread(points, count)
    return points[kept], _palette(kind[kept] + 0.08 * points[kept, 2])


def _trefoil_frame(along: Floats) -> tuple[Floats, Floats, Floats]:
    """Centre line of a trefoil with its normal and binormal, each ``(len(along), 3)``."""
    t = along
    centre = [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.25 * np.sin(3 * t)]
    first = [
        np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3.75 * np.cos(3 * t)
    ]  # fmt: skip
    second = [
        -np.sin(t) - 8 * np.sin(2 * t), -np.cos(t) + 8 * np.cos(2 * t), 11.25 * np.sin(3 * t)
    ]  # fmt: skip
    tangent, bend = np.stack(first, axis=1), np.stack(second, axis=1)
    up = np.cross(tangent, bend)
    side = np.cross(up, tangent)
    return (
        np.stack(centre, axis=1),
        side / np.linalg.norm(side, axis=1, keepdims=True),
        up / np.linalg.norm(up, axis=1, keepdims=True),
    )


def _unit_square(around: Floats) -> Floats:
    """Walk once round the square of half side 1, at constant speed: ``(len(around), 2)``."""
    corner = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64)
    stops = np.linspace(0, 1, 5)
    return np.stack([np.interp(around, stops, corner[:, axis]) for axis in (0, 1)], axis=1)


def _sample_grid(rng: np.random.Generator, grid: Floats, count: int) -> tuple[Floats, Floats]:
    """Draw points evenly by area from a grid of quadrilaterals ``(A, B, 3)``.

    Returns:
        points ``(count, 3)`` and where on the grid each lies, ``(count, 2)`` in [0, 1).
    """
    along, around = grid[1:, :-1] - grid[:-1, :-1], grid[:-1, 1:] - grid[:-1, :-1]
    area = np.linalg.norm(np.cross(along, around), axis=2)
    chosen = rng.choice(area.size, count, p=(area / area.sum()).ravel())
    row, column = np.unravel_index(chosen, area.shape)
    u, v = rng.random((2, count, 1))
    points = grid[row, column] + u * along[row, column] + v * around[row, column]
    where = (np.stack([row, column], axis=1) + np.hstack([u, v])) / area.shape
    return points, where


def _spread(points: Floats, count: int) -> NDArray[np.intp]:
    """Choose ``count`` points, each next one the farthest from all before it."""
    kept = np.zeros(count, dtype=np.intp)
    distance = np.full(len(points), np.inf)
    for index in range(1, count):
        offset = points - points[kept[index - 1]]
        distance = np.minimum(distance, np.einsum("ij,ij->i", offset, offset))
        kept[index] = int(distance.argmax())
    return kept


def _palette(phase: Floats) -> Floats:
    """Map a phase to a closed walk through warm and cool colours, ``(len(phase), 3)``."""
    shift = np.array([0.02, 0.35, 0.62])
    return np.asarray(0.62 + 0.3 * np.cos(2 * np.pi * (phase[:, None] - shift)))


def main() -> None:
    """Write every example cloud beside this script."""
    for name, shape, count in (("knot", twisted_knot, 4000), ("block", cut_block, 2500)):
        points, colors = shape(np.random.default_rng(2020), count)
        cloud = Cloud(points.astype(np.float32), colors=np.rint(colors * 255).astype(np.uint8))
        write(cloud, HERE / f"{name}.ply")
        print(f"{name}.ply: {count} points, {(HERE / f'{name}.ply').stat().st_size} bytes")


if __name__ == "__main__":
    main()
