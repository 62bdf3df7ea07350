# SPDX-License-Identifier: Apache-2.0
import io
from typing import Any

import numpy as np
import pytest

from pugeo_model import formats, pipeline, weights
from pugeo_model.cloud import Cloud
from pugeo_model.options import Options
from pugeo_service.engine.answers import agree, assemble, sides, write_tile
from pugeo_service.engine.values import Finished, Prepared


def sphere(scalars: dict[str, Any]) -> Cloud:
    """Return 3,000 points with colours and scalars."""
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    colors = (127 + 127 * points).astype(np.uint8)
    return Cloud(points.astype(np.float32), colors=colors, scalars=scalars)


def in_tiles(cloud: Cloud, **options: Any) -> tuple[Prepared, list[Finished]]:
    """Take a cloud through all steps but the last, in some tiles."""
    model = weights.load("standard")
    plan = pipeline.survey(cloud, Options(ratio=2, **options), tile_size=1200)
    found = []
    for tile in plan.tiles:
        job = pipeline.prepare(tile)
        charts = [pipeline.predict(model, patch, job.candidates) for patch in job.patches]
        landed = [pipeline.land(model, each) for each in pipeline.propose(job, charts)]
        merged = pipeline.merge(job, charts, landed)
        points = [pipeline.land(model, each) for each in merged]
        found.append(Finished(pipeline.finish(job, points), 0.0))
    assert len(found) > 2
    return Prepared(plan, None, {}), found


@pytest.mark.parametrize("orient", ["mst", "outward"])
def test_tile_by_tile_or_together(orient: str) -> None:
    """The bytes are those of the whole, in each format that is written tile by tile."""
    prepared, tiles = in_tiles(sphere({"time": np.arange(3000.0)}), orient=orient)
    for answer in ("ply", "ply-ascii", "xyz"):
        agreed = agree(prepared, [sides(tile) for tile in tiles], answer)
        rows = [write_tile(tile, agreed, number) for number, tile in enumerate(tiles)]
        whole = assemble(prepared, tiles, answer)
        assert b"".join(each.data for each in rows) == whole.data.tobytes()
        assert agreed.report == whole.report
    back = formats.read(io.BytesIO(assemble(prepared, tiles, "ply").data.tobytes()))
    assert back.normals is not None
    assert (np.sum(back.normals * back.points, axis=1) > 0).all()


def test_what_is_not_written_tile_by_tile() -> None:
    """Formats with a column after the other, and integers whose width all values decide."""
    plain, wide = sphere({}), sphere({"time": np.arange(3000)})
    assert {name for name in formats.FORMATS if formats.by_rows(plain, name)} == {
        "ply",
        "ply-ascii",
        "xyz",
    }
    assert formats.by_rows(wide, "ply") is None
