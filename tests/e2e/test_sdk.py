# SPDX-License-Identifier: Apache-2.0
"""The SDK against a real service with real workers."""

import asyncio
import inspect
import io
import json
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from pugeo_client import AsyncClient, Client, Result
from pugeo_client.errors import (
    BadRequestError,
    NotFoundError,
    UnprocessableError,
    UnsupportedFormatError,
)

EXAMPLE = "examples/block.ply"


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str


Ask = Callable[[Callable[[Any], Any]], Any]


@pytest.fixture(params=["sync", "async"])
def ask(request: pytest.FixtureRequest, server: Server) -> Ask:
    """Make a call with either client and wait for its end."""

    def wait(call: Callable[[Any], Any]) -> Any:
        with Client(server.url) as client:
            outcome = call(client)
            return list(outcome) if isinstance(outcome, Iterator) else outcome

    async def collect(call: Callable[[Any], Any]) -> Any:
        async with AsyncClient(server.url) as client:
            outcome = call(client)
            if isinstance(outcome, AsyncIterator):
                return [result async for result in outcome]
            assert inspect.isawaitable(outcome)
            return await outcome

    if request.param == "sync":
        return wait
    return lambda call: asyncio.run(collect(call))


def check(dense: Result, count: int) -> None:
    """A dense cloud has exactly so many finite points, and as many unit normals."""
    assert dense.points.shape == (count, 3)
    assert np.isfinite(dense.points).all()
    assert dense.normals is not None
    np.testing.assert_allclose(np.linalg.norm(dense.normals, axis=1), 1, atol=1e-4)


def test_a_file_becomes_a_denser_file(ask: Ask, root: Path, tmp_path: Path) -> None:
    """The example comes back four times as dense, coloured, with its description."""
    out = tmp_path / "dense.ply"
    stages: list[str] = []
    dense = ask(
        lambda client: client.upsample(
            root / EXAMPLE, 4, out=out, on_progress=lambda stage, *_: stages.append(stage)
        )
    )
    check(dense, 10_000)
    assert dense.colors.shape == (10_000, 3)
    assert out.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    meta = dense.meta
    assert (meta.points_in, meta.points_out) == (2500, 10_000)
    assert meta.dropped == {"non_finite": 0, "duplicate": 0, "wild": 0}
    assert len(meta.model_sha256) == 64
    assert meta.request_id
    assert sum(meta.timings.values()) > 0
    assert {"send", "receive"} == set(stages)


def test_arrays_keep_their_precision(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """A georeferenced array comes back in double precision, in its own frame."""
    offset = np.array([500_000.0, 4_649_776.0, 120.0])
    dense = ask(lambda client: client.upsample(sphere.astype(np.float64) + offset, 2))
    check(dense, 1200)
    assert dense.points.dtype == np.float64
    radius = np.linalg.norm(dense.points - offset, axis=1)
    assert abs(radius - 1).max() < 0.1
    assert len(np.unique(dense.points[:, 1])) > 1000


def test_all_attributes_are_kept(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """Colours, a continuous scalar and a label come back for each new point, under any name."""
    cloud = {
        "points": sphere,
        "normals": sphere,
        "colors": np.full((600, 3), 77, dtype=np.uint8),
        "scalars": {
            "intensity": sphere[:, 2].copy(),
            "höhe": (sphere[:, 2] > 0).astype(np.int32),
        },
    }
    dense = ask(lambda client: client.upsample(cloud, 3, orient="input"))
    check(dense, 1800)
    assert (dense.colors == 77).all()
    assert abs(dense.scalars["intensity"] - dense.points[:, 2]).max() < 0.2
    assert set(np.unique(dense.scalars["höhe"])) == {0, 1}
    assert (np.sum(dense.normals * dense.points, axis=1) > 0).all()


@pytest.mark.parametrize("extension", ["npz", "json", "xyz"])
def test_every_format_of_an_answer(
    ask: Ask, sphere: NDArray[np.float32], tmp_path: Path, extension: str
) -> None:
    """The file has the format of its extension, and as many points as in any other."""
    out = tmp_path / f"dense.{extension}"
    dense = ask(lambda client: client.upsample(sphere, n_points=900, out=out))
    assert dense.meta.points_out == 900
    if extension == "npz":
        check(dense, 900)
    elif extension == "json":
        assert np.shape(json.loads(out.read_bytes())["points"]) == (900, 3)
    else:
        assert np.loadtxt(out).shape == (900, 6)


def test_the_same_seed_is_the_same_cloud(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """Equal calls give equal bytes, another seed gives others."""

    def cloud(seed: int) -> bytes:
        data: bytes = ask(lambda client: client.upsample(sphere, 2, seed=seed)).data
        return data

    first, again, other = cloud(1), cloud(1), cloud(2)
    assert first == again
    assert first != other


def test_normals_face_the_viewpoint(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """From inside, all normals of a sphere face inwards."""
    dense = ask(lambda client: client.upsample(sphere, 2, orient="viewpoint", viewpoint=(0, 0, 0)))
    assert (np.sum(dense.normals * dense.points, axis=1) < 0).all()


def test_many_clouds(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """`map` gives every result, in order."""
    sizes = [200, 600, 300, 400, 500]
    clouds = [np.ascontiguousarray(sphere[:: 600 // size][:size]) for size in sizes]
    results = ask(lambda client: client.map(clouds, 2, concurrency=3))
    assert [len(result) for result in results] == [2 * len(cloud) for cloud in clouds]


def test_a_folder_of_clouds(ask: Ask, root: Path, tmp_path: Path) -> None:
    """`map` writes one file for each source; a broken one is its own error."""
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat nonsense\n")
    sources = [root / EXAMPLE, tmp_path / "broken.ply", root / "examples/knot.ply"]
    out = tmp_path / "dense"
    block, broken, knot = ask(lambda client: client.map(sources, out=out, R=2))
    assert isinstance(broken, BadRequestError)
    assert sorted(path.name for path in out.iterdir()) == ["block.ply", "knot.ply"]
    check(block, 5000)
    check(knot, 8000)


def test_lists_and_tensors(ask: Ask, sphere: NDArray[np.float32]) -> None:
    """A list, a torch tensor and an array of the same points give the same cloud."""
    double = sphere.astype(np.float64)
    clouds = ask(lambda client: client.map([double, double.tolist(), torch.tensor(double)], R=2))
    assert clouds[0].data == clouds[1].data == clouds[2].data


@pytest.mark.slow
def test_a_cloud_beyond_the_time_limit(launch: Callable[..., Any], tmp_path: Path) -> None:
    """A cloud that the service cannot finish within one request is finished as a job."""
    points = np.random.default_rng(0).normal(size=(20_000, 3)).astype(np.float32)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    stages: list[str] = []
    options = ("--engine", "inline", "--workers", "1", "--deadline-s", "0.5")
    with launch(*options, SLOW_S="0.3") as server, Client(server.url) as client:
        server.wait_until_ready()
        dense = client.upsample(
            points, 4, out=tmp_path / "d.ply", on_progress=lambda stage, *_: stages.append(stage)
        )
        (job,) = client.jobs()
    check(dense, 80_000)
    assert job.state == "succeeded"
    assert stages[-1] == "receive"
    assert "predict" in stages


@pytest.mark.parametrize(
    ("source", "options", "error", "words"),
    [
        (b"ply\nformat binary_little_endian 1.0\nelement vert", {}, BadRequestError, "header"),
        (b"%PDF-1.7", {}, UnsupportedFormatError, "format"),
        (np.zeros((1, 3)), {}, UnprocessableError, "point"),
        (np.eye(3).repeat(20, axis=0), {}, UnprocessableError, "point"),
        (io.BytesIO(b"0 0 0\n1 0 0\n0 1 0\n"), {"ratio": 99}, UnprocessableError, "R"),
        (b"0 0 0\n", {"orient": "sideways"}, UnprocessableError, "orient"),
    ],
)
def test_refusals_are_typed(
    ask: Ask, source: Any, options: dict[str, Any], error: type[Exception], words: str
) -> None:
    """A refusal of the service is the right exception, with a reason and an id."""
    with pytest.raises(error, match=words) as caught:
        ask(lambda client: client.upsample(source, **options))
    assert getattr(caught.value, "request_id", None)
    assert getattr(caught.value, "retryable", None) is False


def test_health_and_models(ask: Ask) -> None:
    """The service reports that it is ready, and which model it runs."""
    assert ask(lambda client: client.health())["status"] == "ready"
    card, *others = ask(lambda client: client.models())
    assert card["name"] == "fast"
    assert len(card["sha256"]) == 64
    assert {"standard"} <= {other["name"] for other in others}


def test_a_wrong_address(server: Server) -> None:
    """A base URL with an unknown path is NotFoundError, and no connection failure."""
    with Client(server.url + "/elsewhere") as client, pytest.raises(NotFoundError):
        client.models()
