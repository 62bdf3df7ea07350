# SPDX-License-Identifier: Apache-2.0
"""Output stages: writing tile by tile gives the bytes of the assembled cloud."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.service.engine.standard import STANDARD

from pugeo_model import formats, plan, weights
from pugeo_model.cloud import Cloud
from pugeo_model.local_stages import LocalStages
from pugeo_model.options import Options
from pugeo_model.pipeline import run_here, upsample_tile
from pugeo_model.plan import make_plan
from pugeo_service.engine import stages
from pugeo_service.engine.output_stages import agree, assemble, border, write_tile
from pugeo_service.engine.self_test import self_test_request
from pugeo_service.engine.values import DenseTile, Prepared


def sphere(scalars: dict[str, Any], count: int = 3000) -> Cloud:
    """Return points with colours and scalars."""
    directions = np.random.default_rng(0).normal(size=(count, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    colors = (127 + 127 * points).astype(np.uint8)
    return Cloud(points.astype(np.float32), colors=colors, scalars=scalars)


def in_tiles(cloud: Cloud, **options: Any) -> tuple[Prepared, list[DenseTile]]:
    """Take a cloud through all stages but the last, in some tiles."""
    stages_here = LocalStages(weights.load("standard"), lambda _stage, _share: None)
    tiled = make_plan(cloud, Options(ratio=2, **options), tile_size=1200)
    dense = [run_here(upsample_tile(stages_here, tile)) for tile in tiled.tiles]
    assert len(dense) > 2
    return Prepared(tiled, None, {}), [DenseTile(tile, {}, []) for tile in dense]


@pytest.mark.parametrize("orient", ["mst", "outward"])
def test_tile_by_tile_or_together(orient: str) -> None:
    """Tiles written one by one give the bytes of the assembled cloud."""
    prepared, tiles = in_tiles(sphere({"time": np.arange(3000.0)}), orient=orient)
    for answer in ("ply", "ply-ascii", "xyz"):
        agreed = agree(prepared, [border(tile) for tile in tiles], answer)
        rows = [write_tile(tile, agreed, number).data for number, tile in enumerate(tiles)]
        whole = assemble(prepared, tiles, answer)
        assert np.array_equal(np.concatenate(rows), whole.data)
        assert agreed.report == whole.report
    back = formats.read(io.BytesIO(assemble(prepared, tiles, "ply").data.tobytes()))
    assert back.normals is not None
    assert (np.sum(back.normals * back.points, axis=1) > 0).all()


@pytest.mark.parametrize(
    ("answer", "options", "scalars", "expected"),
    [
        ("ply", {}, {"time": np.arange(9000.0)}, True),
        ("xyz", {}, {"part": np.arange(9000, dtype=np.int32)}, True),
        # Stored column by column.
        ("npz", {}, {}, False),
        # The width of integers depends on all values.
        ("ply", {}, {"time": np.arange(9000)}, False),
        # The points of the input precede those of all tiles.
        ("ply", {"keep_input": True}, {}, False),
    ],
)
def test_what_is_written_tile_by_tile(
    monkeypatch: pytest.MonkeyPatch,
    answer: str,
    options: dict[str, Any],
    scalars: dict[str, Any],
    expected: bool,
) -> None:
    """Clouds that can be written tile by tile, and clouds that cannot."""
    cut = plan.make_plan
    monkeypatch.setattr(
        plan, "make_plan", lambda cloud, options, **more: cut(cloud, options, 3000, **more)
    )
    file = io.BytesIO()
    formats.write(sphere(scalars, 9000), file, format="npz")
    order = replace(
        self_test_request(STANDARD, 60.0),
        answer=answer,
        options={"ratio": 2.0, **options},
        max_points=9000,
        max_output_points=18_000,
    )
    prepared = stages.prepare(np.frombuffer(file.getvalue(), np.uint8), order)
    assert prepared.plan is not None
    assert len(prepared.plan.tile_specs) > 2
    assert prepared.by_rows is expected
