# SPDX-License-Identifier: Apache-2.0
"""Denoising in the engine."""

import asyncio
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tests.service.engine.standard import STANDARD

from pugeo_model import Cloud, formats, tiles
from pugeo_model.assembly import Result
from pugeo_model.upsampler import Upsampler
from pugeo_service.engine import Engine
from pugeo_service.engine.messages import InMemory
from pugeo_service.engine.self_test import self_test_request
from pugeo_service.settings import Settings

pytestmark = pytest.mark.slow

REQUEST = replace(
    self_test_request(STANDARD, deadline_s=60.0), max_points=10_000, max_output_points=20_000
)


@pytest.fixture(scope="module")
def noisy() -> Cloud:
    """A sphere of 6,000 points with noise of half their spacing."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Cloud((points + rng.normal(size=points.shape, scale=0.02)).astype(np.float32))


@pytest.fixture(scope="module")
def folded() -> Cloud:
    """A folded sheet, sampled so coarsely that its folds look like noise, without stray points."""
    cells = np.stack(np.meshgrid(np.arange(78), np.arange(78)), axis=-1).reshape(-1, 2)
    u, v = (cells + np.random.default_rng(0).uniform(0.1, 0.9, cells.shape)).T * (60 / 78)
    return Cloud(np.column_stack([u, v, 0.8 * np.abs((u + 0.3 * v) % 4 - 2)]).astype(np.float32))


def ignore(_: int) -> None:
    """Ignore progress."""


def answer(cloud: Cloud, at_once: int, tmp_path: Path) -> NDArray[np.float32]:
    """Points of the answer of the engine."""
    body = io.BytesIO()
    formats.write(cloud, body, format="ply")
    request = replace(REQUEST, one_task_patches=at_once)

    async def whole() -> bytes:
        engine = Engine(Settings(engine="inline", workers=2, spool_dir=tmp_path), STANDARD)
        await engine.start()
        try:
            data = InMemory(np.frombuffer(body.getvalue(), np.uint8))
            outcome = await engine.run(data, request, on_patches=ignore, on_done=ignore)
            with outcome.spool as spool:
                return (await spool.read()).tobytes()
        finally:
            await engine.stop()

    return formats.read(io.BytesIO(asyncio.run(whole())), format="ply").points


@pytest.fixture(scope="module")
def known() -> dict[tuple[bytes, int | None], Result]:
    """Results of the library, by cloud and size of tiles."""
    return {}


@pytest.fixture(params=[(9, None), (1, None), (1, 2000)], ids=["at once", "in parts", "in tiles"])
def both(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    known: dict[tuple[bytes, int | None], Result],
) -> Callable[[Cloud], tuple[Result, NDArray[np.float32]]]:
    """Results of the library and of the engine, for each of the engine's ways."""
    at_once, tile = request.param

    def made(cloud: Cloud) -> tuple[Result, NDArray[np.float32]]:
        if tile:
            monkeypatch.setattr(tiles, "_FEWEST", tile)
            monkeypatch.setattr(tiles, "_MOST", tile)
        torch.set_num_threads(1)
        key = (cloud.points.tobytes(), tile)
        if key not in known:
            known[key] = Upsampler()(cloud, 2.0)
        wanted = known[key]
        assert wanted.report["noise"] > 0.1
        assert wanted.report["tiles"] == (3 if tile else 1)
        return wanted, answer(cloud, at_once, tmp_path)

    return made


def test_the_service_denoises_as_the_library_does(
    both: Callable[[Cloud], tuple[Result, NDArray[np.float32]]], noisy: Cloud
) -> None:
    """Both results are equal bit by bit, and closer to the surface."""
    wanted, found = both(noisy)
    np.testing.assert_array_equal(found, wanted.cloud.points.astype(np.float32))
    off = [np.abs(np.linalg.norm(each, axis=1) - 1).mean() for each in (noisy.points, found)]
    assert off[1] < 0.4 * off[0]


def test_the_service_keeps_detail_as_the_library_does(
    both: Callable[[Cloud], tuple[Result, NDArray[np.float32]]], folded: Cloud
) -> None:
    """A cloud whose points hardly move keeps them, with the same result as in the library."""
    wanted, found = both(folded)
    np.testing.assert_array_equal(found, wanted.cloud.points.astype(np.float32))
    stayed = {tuple(point) for point in folded.points} & {tuple(point) for point in found}
    assert len(stayed) > 500
