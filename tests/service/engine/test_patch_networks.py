# SPDX-License-Identifier: Apache-2.0
"""A network that upsamples whole patches, on its way through the engine."""

import asyncio
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from pugeo_model import Cloud, formats, tiles
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture
from pugeo_model.upsampler import Upsampler
from pugeo_model.weights import save
from pugeo_service.engine import Engine
from pugeo_service.engine.messages import InMemory
from pugeo_service.engine.self_test import self_test_request
from pugeo_service.models import Models
from pugeo_service.settings import Settings

pytestmark = pytest.mark.slow

ARCHITECTURE = Architecture(
    "pugeo-net", 16, (("ratio", 4), ("k", 8), ("width", 8), ("fused", 16)), 8
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Untrained weights of PUGeo-Net as published."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "paper.safetensors"
    save(build_network(ARCHITECTURE), {"name": "paper", "version": "1"}, path)
    return str(path)


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    """A sphere of 6,000 random points."""
    points = np.random.default_rng(0).normal(size=(6000, 3))
    return Cloud((points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32))


def answer(cloud: Cloud, weights: str, at_once: int, folder: Path) -> NDArray[np.float32]:
    """Points of the engine's answer."""
    body = io.BytesIO()
    formats.write(cloud, body, format="ply")
    settings = Settings(engine="inline", workers=2, spool_dir=folder, model=weights)
    models = Models(settings)
    request = replace(
        self_test_request(models.default.id, deadline_s=60.0),
        max_points=10_000,
        max_output_points=20_000,
        one_task_patches=at_once,
    )

    async def whole() -> bytes:
        engine = Engine(settings, models.default.id)
        await models.install(engine)
        await engine.start()
        try:
            data = InMemory(np.frombuffer(body.getvalue(), np.uint8))
            outcome = await engine.run(
                data, request, on_patches=lambda _: None, on_done=lambda _: None
            )
            with outcome.spool as spool:
                return (await spool.read()).tobytes()
        finally:
            await engine.stop()

    return formats.read(io.BytesIO(asyncio.run(whole())), format="ply").points


@pytest.mark.parametrize(
    ("at_once", "tile"), [(99, None), (1, None), (1, 2000)], ids=["at once", "in parts", "in tiles"]
)
def test_the_service_answers_as_the_library_does(
    at_once: int,
    tile: int | None,
    cloud: Cloud,
    weights: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To the last bit, whatever way the cloud goes; noise does not send it round again."""
    if tile:
        monkeypatch.setattr(tiles, "_FEWEST", tile)
        monkeypatch.setattr(tiles, "_MOST", tile)
    torch.set_num_threads(1)
    wanted = Upsampler(weights)(cloud, 2.0)
    assert wanted.report["tiles"] == (3 if tile else 1)
    found = answer(cloud, weights, at_once, tmp_path)
    np.testing.assert_array_equal(found, wanted.cloud.points.astype(np.float32))
    assert len(found) == 12_000
