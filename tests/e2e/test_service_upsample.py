# SPDX-License-Identifier: Apache-2.0
"""POST /upsample of a real service: all input and output formats, headers, options."""

import io
import json
from typing import Any, Protocol

import httpx2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.http_client import HTTP

from pugeo_model import Cloud, formats
from pugeo_model.formats import WRITABLE


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str


def encode(cloud: Cloud, name: str) -> bytes:
    """A cloud as a file."""
    buffer = io.BytesIO()
    formats.write(cloud, buffer, format=name)
    return buffer.getvalue()


def decode(data: bytes, name: str) -> Cloud:
    """A file as a cloud."""
    return formats.read(io.BytesIO(data), format=name)


def npy(points: NDArray[Any]) -> bytes:
    """Points as an NPY file."""
    buffer = io.BytesIO()
    np.save(buffer, points)
    return buffer.getvalue()


def post(server: Server, query: str = "", **arguments: Any) -> httpx2.Response:
    """Send a request to /upsample."""
    return HTTP.post(f"{server.url}/upsample{query}", timeout=60, **arguments)


@pytest.fixture(scope="module")
def cloud(sphere: NDArray[np.float32]) -> Cloud:
    """A sphere."""
    return Cloud(sphere)


INPUTS = [
    ("ply", "application/x-ply"),
    ("ply", "application/octet-stream"),
    ("ply", "application/x-www-form-urlencoded"),
    ("ply-ascii", "text/plain"),
    ("npz", "application/x-npz"),
    ("json", "application/json"),
    ("json", "application/octet-stream"),
    ("xyz", "text/plain"),
]


@pytest.mark.parametrize("answer", list(WRITABLE))
@pytest.mark.parametrize(("name", "content_type"), INPUTS)
def test_every_way_in_and_out(
    server: Server, cloud: Cloud, name: str, content_type: str, answer: str
) -> None:
    """Any input gives any output: exactly R times the points, on the sphere, with unit normals."""
    response = post(
        server,
        f"?R=2.5&format={answer}",
        content=encode(cloud, name),
        headers={"Content-Type": content_type},
    )
    assert response.status_code == 200, response.text
    assert response.headers["content-type"].startswith(WRITABLE[answer].MEDIA_TYPES[0])
    dense = decode(response.content, answer)
    assert dense.points.shape == (1500, 3)
    assert np.abs(np.linalg.norm(dense.points, axis=1) - 1).max() < 0.1
    if answer == "ptx":
        # The format has no room for normals, and a note says so.
        assert dense.normals is None
        assert "normals" in response.headers["Pugeo-Notes"]
        return
    assert dense.normals is not None
    assert np.abs(np.linalg.norm(dense.normals, axis=1) - 1).max() < 1e-3


def test_a_form(server: Server, cloud: Cloud) -> None:
    """A multipart upload, as of browsers and curl -F, works."""
    response = post(server, "?R=2", files={"file": ("scan.ply", encode(cloud, "ply"))})
    assert response.status_code == 200, response.text
    assert len(decode(response.content, "ply")) == 1200


def test_a_bare_array(server: Server, cloud: Cloud) -> None:
    """An NPY file of points is accepted."""
    response = post(server, "?R=2", content=npy(cloud.points))
    assert response.status_code == 200, response.text
    assert len(decode(response.content, "npy")) == 1200


@pytest.mark.parametrize("name", list(WRITABLE))
@pytest.mark.parametrize("accept", ["", "*/*"])
def test_the_format_of_the_input(server: Server, cloud: Cloud, name: str, accept: str) -> None:
    """Without a wish the answer has the format of the input, whatever the body's type says."""
    headers = {"Content-Type": "application/octet-stream", "Accept": accept}
    response = post(server, "?R=2", content=encode(cloud, name), headers=headers)
    assert response.status_code == 200, response.text
    assert response.headers["content-type"].startswith(WRITABLE[name].MEDIA_TYPES[0])
    assert len(decode(response.content, name)) == 1200


def test_an_input_that_is_only_read(server: Server, cloud: Cloud) -> None:
    """The vertices of an OBJ file give PLY, and a note says so."""
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in cloud.points.tolist())
    response = post(server, "?R=2", content=lines.encode())
    assert response.status_code == 200, response.text
    assert len(decode(response.content, "ply")) == 1200
    assert "PLY by default" in response.headers["Pugeo-Notes"]


def test_a_body_of_unknown_length(server: Server, cloud: Cloud) -> None:
    """A chunked body works."""
    data = encode(cloud, "ply")
    pieces = (data[start : start + 1000] for start in range(0, len(data), 1000))
    response = post(server, "?R=2", content=pieces)
    assert response.status_code == 200, response.text


@pytest.mark.parametrize("accept", ["application/x-npz", "application/json;q=0.2, model/ply"])
def test_accept(server: Server, cloud: Cloud, accept: str) -> None:
    """Accept selects the format if the query does not, and Vary lists it."""
    response = post(server, content=encode(cloud, "ply"), headers={"Accept": accept})
    expected = "npz" if "npz" in accept else "ply"
    assert response.headers["content-type"] == WRITABLE[expected].MEDIA_TYPES[0]
    assert response.headers["vary"] == "Accept"


def test_json_in_means_json_out(server: Server) -> None:
    """A JSON body with any Accept gets JSON."""
    points = np.random.default_rng(0).normal(size=(50, 3)).tolist()
    response = post(server, "?R=2", json={"points": points})
    found = json.loads(response.content)
    assert len(found["points"]) == 100
    assert len(found["normals"]) == 100


def test_headers(server: Server, cloud: Cloud) -> None:
    """Headers contain the model, the numbers of points, dropped points, and times of stages."""
    points = np.concatenate([cloud.points, cloud.points[:7], np.full((5, 3), np.nan)])
    response = post(
        server,
        "?R=2",
        content=encode(Cloud(points.astype(np.float32)), "ply"),
        headers={"X-Request-ID": "my-request"},
    )
    card = HTTP.get(f"{server.url}/models", timeout=60).json()["models"][0]
    headers = response.headers
    assert headers["x-request-id"] == "my-request"
    assert headers["pugeo-model-version"] == card["version"]
    assert headers["pugeo-model-sha256"] == card["sha256"]
    assert headers["pugeo-points-in"] == "612"
    assert headers["pugeo-points-out"] == "1200"
    assert headers["pugeo-dropped-non-finite"] == "5"
    assert headers["pugeo-dropped-duplicate"] == "7"
    assert isinstance(json.loads(headers["pugeo-notes"]), list)
    assert int(headers["content-length"]) == len(response.content)
    stages = [part.split(";dur=") for part in headers["server-timing"].split(", ")]
    assert [stage for stage, _ in stages] == [
        "queue", "read", "prepare", "predict", "merge", "project", "finish", "write", "collect",
    ]  # fmt: skip
    assert all(float(spent) >= 0 for _, spent in stages)


def test_options_reach_the_model(server: Server, cloud: Cloud) -> None:
    """Count, seed and viewpoint have an effect, and the same seed gives the same bytes."""
    data = encode(cloud, "ply")

    def ask(query: str) -> bytes:
        response = post(server, query, content=data)
        assert response.status_code == 200, response.text
        return response.content

    assert len(decode(ask("?n_points=777"), "ply")) == 777
    assert ask("?R=3&seed=1") == ask("?R=3&seed=1")
    assert ask("?R=3&seed=1") != ask("?R=3&seed=2")
    inward = decode(ask("?R=2&orient=viewpoint&viewpoint=0,0,0"), "ply")
    outward = decode(ask("?R=2&orient=outward"), "ply")
    assert inward.normals is not None
    assert outward.normals is not None
    assert (np.einsum("ij,ij->i", inward.points, inward.normals) < 0).mean() > 0.99
    assert (np.einsum("ij,ij->i", outward.points, outward.normals) > 0).mean() > 0.99


def test_large_coordinates_stay_double(server: Server, cloud: Cloud) -> None:
    """A scan in UTM coordinates keeps its precision and its place."""
    offset = np.array([500_000.0, 5_400_000.0, 300.0])
    data = encode(Cloud(cloud.points.astype(np.float64) + offset), "ply")
    dense = decode(post(server, "?R=2", content=data).content, "ply")
    assert dense.points.dtype == np.float64
    assert np.abs(np.linalg.norm(dense.points - offset, axis=1) - 1).max() < 0.1


def test_the_service_computes_what_the_library_does(server: Server) -> None:
    """The service gives the same points as the library in one process."""
    from pugeo_model.upsampler import Upsampler

    directions = np.random.default_rng(3).normal(size=(5000, 3))
    sphere = Cloud((directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype("f4"))
    response = post(server, "?R=2&seed=5&model=standard", content=encode(sphere, "ply"))
    assert response.status_code == 200, response.text
    here = Upsampler()(sphere, 2.0, seed=5).cloud
    there = decode(response.content, "ply")
    np.testing.assert_allclose(there.points, here.points, atol=1e-6)
