# SPDX-License-Identifier: Apache-2.0
"""Models by name on a real service: released ones, the canary, and weights replaced meanwhile."""

import io
import shutil
import time
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from tests.http_client import HTTP

from pugeo_client import Client
from pugeo_model import Cloud, Upsampler, formats, weights

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    """An ellipsoid of 500 points."""
    directions = np.random.default_rng(3).normal(size=(500, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return Cloud((sphere * [1.0, 0.7, 0.5]).astype(np.float32))


def answer(server: Any, cloud: Cloud, query: str, **headers: str) -> httpx2.Response:
    """The service's answer with R=2, as PLY."""
    body = io.BytesIO()
    formats.write(cloud, body, format="ply")
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    url = f"{server.url}/upsample?R=2{query}"
    response = HTTP.post(url, content=body.getvalue(), headers=named, timeout=120)
    assert response.status_code == 200, response.text
    return response


def by_the_library(model: str, cloud: Cloud) -> bytes:
    """The answer of released weights, as PLY."""
    file = io.BytesIO()
    formats.write(Upsampler(model)(cloud, 2.0).cloud, file, format="ply")
    return file.getvalue()


def test_a_request_names_its_model(server: Any, cloud: Cloud) -> None:
    """Each name gives the answer of its weights, and the answer says which ran."""
    for name in ("fast", "standard"):
        response = answer(server, cloud, f"&model={name}")
        assert response.content == by_the_library(name, cloud)
        assert response.headers["pugeo-model"] == name
        assert response.headers["pugeo-model-sha256"] == weights.read_card(name)["sha256"]
    refused = HTTP.post(f"{server.url}/upsample?model=huge", content=b"1 2 3")
    assert (refused.status_code, refused.json()["code"]) == (422, "unknown_model")
    assert refused.json()["allowed"] == ["fast", "standard"]


def test_the_header_chooses_the_canary(server: Any, cloud: Cloud) -> None:
    """The canary, whose share is 0 here, runs for requests that ask for it."""
    chosen = {wish: answer(server, cloud, "", pugeo_canary=wish) for wish in ("yes", "no", "")}
    models = {wish: response.headers["pugeo-model"] for wish, response in chosen.items()}
    assert models == {"yes": "standard", "no": "fast", "": "fast"}
    listed = HTTP.get(f"{server.url}/models").json()
    assert (listed["default"], listed["canary"]) == ("fast", {"name": "standard", "share": 0})


def test_weights_are_replaced_while_the_service_runs(server: Any, cloud: Cloud) -> None:
    """Weights put into the folder are a new model on all workers; others of that name replace it.

    The same holds for jobs.
    """
    folder = Path(server.log).parent / "models"
    try:
        for released in ("fast", "standard"):
            sha256 = weights.read_card(released)["sha256"]
            for suffix in (".safetensors", ".json"):
                source = weights.locate(released).with_suffix(suffix)
                shutil.copy(source, folder / f"mine{suffix}")
            end = time.monotonic() + 120
            while HTTP.get(f"{server.url}/models/mine").json().get("sha256") != sha256:
                assert time.monotonic() < end, server.log.read_text()[-4000:]
                time.sleep(0.1)
            wanted = by_the_library(released, cloud)
            # Several, so that each worker gets one.
            for _ in range(4):
                assert answer(server, cloud, "&model=mine").content == wanted
        with Client(server.url) as client:
            result = client.submit(cloud.points, 2, model="mine").result()
            assert (result.meta.model, result.data) == ("mine", wanted)
            assert next(card["name"] for card in client.models()) == "fast"
    finally:
        for suffix in (".safetensors", ".json"):
            (folder / f"mine{suffix}").unlink(missing_ok=True)
