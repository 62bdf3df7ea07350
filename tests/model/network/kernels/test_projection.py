# SPDX-License-Identifier: Apache-2.0
"""The compiled projection against its definition in torch."""

import numpy as np
import pytest
import torch

from pugeo_model.geometry.frames import Frames
from pugeo_model.network.heads import SurfaceHead
from pugeo_model.network.kernels import projection
from pugeo_model.network.kernels.projection import Projector
from pugeo_model.network.precision import wide_products
from pugeo_model.network.projection import blend
from pugeo_model.network.pugeo import Charts
from pugeo_model.resample.atlas import Atlas, ProjectionQuery

CHARTS, QUERIES, WIDTH = 40, 2500, 128


def rotations(rng: np.random.Generator) -> np.ndarray:
    """Random orthonormal frames ``(CHARTS, 3, 3)``."""
    return np.linalg.qr(rng.normal(size=(CHARTS, 3, 3)))[0].astype(np.float32)


@pytest.fixture(scope="module")
def queries() -> ProjectionQuery:
    """More queries than one block, on charts of different sizes and directions."""
    rng = np.random.default_rng(0)
    points = 100.0 + rng.normal(size=(CHARTS, 3))
    charts = rng.integers(CHARTS, size=(QUERIES, 3)).astype(np.int32)
    spacing = rng.uniform(0.1, 0.3, CHARTS).astype(np.float32)
    first = charts[:, 0]
    positions = points[first] + rng.normal(size=(QUERIES, 3)) * spacing[first, None]
    frames = Frames(
        axes=rotations(rng),
        spacing=spacing,
        quadric=rng.normal(scale=0.2, size=(CHARTS, 6)).astype(np.float32),
        residual=np.zeros(CHARTS, dtype=np.float32),
        noise=0.0,
    )
    atlas = Atlas(
        points=points,
        frames=frames,
        candidates=np.empty((CHARTS, 0, 3), dtype=np.float32),
        T=rotations(rng),
        code=rng.normal(size=(CHARTS, WIDTH)).astype(np.float16),
        lift=rng.normal(scale=0.1, size=CHARTS).astype(np.float32),
    )
    return ProjectionQuery(atlas, positions, charts)


def test_the_compiled_projection_equals_its_definition(queries: ProjectionQuery) -> None:
    """Steps, normals and predicted errors equal those of ``blend`` up to bfloat16."""
    torch.manual_seed(0)
    surface = SurfaceHead(16, WIDTH, 64)
    with torch.no_grad():
        surface.out.weight.mul_(30.0)
    atlas, frames = queries.atlas, queries.atlas.frames
    rows = torch.from_numpy(queries.charts.astype(np.int64))
    flat = rows.flatten()
    charts = Charts(
        torch.from_numpy(atlas.T)[flat],
        torch.from_numpy(atlas.code).float()[flat],
        torch.from_numpy(atlas.lift)[flat],
        torch.from_numpy(frames.quadric)[flat],
    )
    offsets = (queries.points[:, None] - atlas.points[queries.charts]).astype(np.float32)
    spacing = torch.from_numpy(frames.spacing)[rows]
    with torch.inference_mode(), wide_products():
        step, normals, log_error, _ = blend(
            surface,
            charts,
            torch.from_numpy(offsets),
            torch.from_numpy(frames.axes)[rows],
            spacing,
        )
    found = Projector(surface)(queries)
    # Relative to the move, since charts far from a query extrapolate.
    scale = 1.0 + step.norm(dim=1).numpy()
    assert np.quantile(np.abs(found[0] - step.numpy()).max(axis=1) / scale, 0.99) < 0.01
    assert np.quantile(np.abs(found[1] - normals.numpy()).max(axis=1), 0.95) < 0.02
    assert np.quantile(np.abs(found[2] - log_error.numpy()), 0.99) < 0.05
    assert np.allclose(np.linalg.norm(found[1], axis=1), 1.0, atol=1e-5)


def test_a_projection_is_reproducible(queries: ProjectionQuery) -> None:
    """The same queries give the same bytes, with used buffers too."""
    projector = Projector(SurfaceHead(16, WIDTH, 64))
    once, twice = projector(queries), projector(queries)
    assert all(np.array_equal(once[part], twice[part]) for part in range(3))


def test_a_processor_without_bfloat16(
    queries: ProjectionQuery, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the wide layer in float32 the results are nearly the same."""
    surface = SurfaceHead(16, WIDTH, 64)
    projected = []
    for pays in (True, False):
        monkeypatch.setattr(projection, "bfloat16_pays", lambda pays=pays: pays)
        projected.append(Projector(surface)(queries))
    for one, other in zip(*projected, strict=True):
        np.testing.assert_allclose(one, other, atol=0.01)
