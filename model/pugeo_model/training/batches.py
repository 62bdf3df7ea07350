# SPDX-License-Identifier: Apache-2.0
"""Training batches: patches of inputs with samples of the true surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch.utils.data import Dataset

from pugeo_model.geometry.centres import choose_centres
from pugeo_model.geometry.frames import Frames, fit_frames
from pugeo_model.geometry.neighbours import knn, nearest, spacing
from pugeo_model.geometry.patches import Patch, extract_patch
from pugeo_model.geometry.scale import measure_scale
from pugeo_model.mesh.virtual_sensors import Scan, Scene, Surface, dense, everywhere, scan
from pugeo_model.training.augment import Mix, draw
from pugeo_model.training.corpus import Shape

__all__ = ["RATIOS", "Batches", "Sample"]

RATIOS: tuple[tuple[int, float, int], ...] = (
    (4, 0.25, 5),
    (6, 0.30, 5),
    (8, 0.20, 5),
    (16, 0.13, 3),
    (24, 0.09, 2),
    (32, 0.03, 2),
)
"""Samples per chart, probability, patches per step: all steps have about the same cost.

6 and 24 are the candidates per chart of the ratios 4 and 16, which use 1.5 candidates per output
point.
"""

_CORE = 256  # points in the core of a patch
_AROUND = 900  # points that contain the rings of the core and their neighbours
_TRUTHS = 1200  # ground-truth samples per patch
_REDUNDANT = 4000  # points of a scan around the seed of which centres are chosen
_FEWEST = 64  # centres of a usable patch
_OWNERS = 6  # nearest input points of a ground-truth sample, all of which must be in the core
_LARGEST_GAP = 1.1  # spacings; samples further from any input point are holes in the data


@dataclass(frozen=True, eq=False)
class Sample:
    """A patch with samples of the true surface.

    Attributes:
        shape: index of the shape.
        patch: input of the network.
        truths: ``(G, 3)`` float32 samples of the true surface near the core.
        owners: ``(G, 6)`` core rows of the charts that may cover each sample.
        near: ``(core, 12)`` rows of the nearest neighbours of core points; rows >= core have no
            chart.
        noise: standard deviation of the noise of the input, in mean spacings.
    """

    shape: int
    patch: Patch
    truths: NDArray[np.float32]
    owners: NDArray[np.int64]
    near: NDArray[np.int64]
    noise: float


def _centres(points: NDArray[np.float64], noise: float) -> tuple[NDArray[np.float64], float]:
    """Centres of charts ``(C, 3)``, as in `represent`, and their remaining noise."""
    distances, neighbours = nearest(points)
    scale = measure_scale(points, neighbours, distances)
    centres = choose_centres(points, scale, np.zeros(len(points), np.bool_))
    if len(centres.points) < _FEWEST:
        return points, noise
    averaged = centres.count > 1
    members = float(np.median(centres.count[averaged])) if averaged.any() else 1.0
    # Balls overlap, so a mean gains less than the root of all points inside.
    return centres.points, noise / np.sqrt(max(members, 1.0))


class Batches(Dataset[tuple[int, list[Sample]]]):
    """Batches by step; each depends on ``(seed, step)`` only, so that training resumes exactly.

    Args:
        shapes: the corpus.
        mix: probabilities of the kinds of input.
        seed: seed of all random numbers.
        steps: number of batches.
    """

    def __init__(self, shapes: list[Shape], mix: Mix, seed: int, steps: int) -> None:
        self.shapes, self.mix, self.seed, self.steps = shapes, mix, seed, steps
        self._scenes: dict[int, Scene] = {}

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, step: int) -> tuple[int, list[Sample]]:
        """Return the number of samples per chart of a step, and its patches."""
        rng = np.random.default_rng([self.seed, step])
        index = rng.choice(len(RATIOS), p=[probability for _, probability, _ in RATIOS])
        count, _, patches = RATIOS[index]
        return count, [self._sample(rng) for _ in range(patches)]

    @property
    def _has_sensors(self) -> bool:
        """True if the mix has scans; others draw the same batches as before there were sensors."""
        return self.mix.sensors > 0.0 or self.mix.dense > 0.0

    def _draw(self, index: int, rng: np.random.Generator) -> Scan:
        """Draw an input of a shape."""
        shape, mix = self.shapes[index], self.mix
        if self._has_sensors:
            kind = rng.random()
            if kind < mix.sensors:
                if index not in self._scenes:
                    surface = Surface(shape.vertices, shape.faces, shape.normals, shape.pool)
                    self._scenes[index] = Scene(surface)
                made = scan(self._scenes[index], rng)
                if made is not None:
                    return made
            elif kind < mix.sensors + mix.dense:
                return dense(shape.pool, rng)
        points, noise = draw(shape, mix, rng)
        return Scan(points, noise, everywhere, redundant=False)

    def _sample(self, rng: np.random.Generator) -> Sample:
        """Draw one patch around a random point of a random shape."""
        index = int(rng.integers(len(self.shapes)))
        shape = self.shapes[index]
        drawn = self._draw(index, rng)
        points, noise = drawn.points, drawn.noise
        tree = cKDTree(points)
        seed = points[rng.integers(len(points))]
        if self._has_sensors and (noise or drawn.redundant):
            around = knn(tree, seed[None], min(_REDUNDANT, len(points)))[1][0]
            points, noise = _centres(points[around], noise)
            seed = points[np.argmin(((points - seed) ** 2).sum(axis=1))]
            tree = cKDTree(points)
        around = knn(tree, seed[None], min(_AROUND, len(points)))[1][0]
        points = points[around]
        core_count = min(_CORE, len(points))
        tree = cKDTree(points)
        distance, neighbours = nearest(points)
        # The outermost points lack some neighbours; only the outer rings use their frames.
        frames = fit_frames(points, neighbours, spacing(distance))
        patch = extract_patch(np.arange(core_count, dtype=np.int32), points, neighbours, frames)
        truths, owners = self._truths(shape, drawn, tree, frames, core_count, seed, rng)
        near = patch.neighbours[:core_count, :12].astype(np.int64)
        typical = float(frames.spacing[:core_count].mean())
        return Sample(index, patch, truths, owners, near, noise / typical)

    def _truths(
        self,
        shape: Shape,
        drawn: Scan,
        tree: cKDTree,
        frames: Frames,
        core: int,
        seed: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Samples of the true surface near the core, and the charts that may cover each."""
        radius = float(np.linalg.norm(tree.data[core - 1] - seed)) if core else 0.0
        offset = shape.pool - seed.astype(np.float32)
        inside = np.flatnonzero((offset * offset).sum(axis=1) < radius * radius)
        chosen = shape.pool[rng.permutation(inside)[: 2 * _TRUTHS]]
        chosen = chosen[drawn.is_seen(chosen.astype(np.float64))]
        distance, owners = knn(tree, chosen, _OWNERS)
        owned = (owners < core).all(axis=1)
        owned &= distance[:, 0] < _LARGEST_GAP * frames.spacing[np.minimum(owners[:, 0], core - 1)]
        return chosen[owned][:_TRUTHS], owners[owned][:_TRUTHS]
