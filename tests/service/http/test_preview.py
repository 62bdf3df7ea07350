# SPDX-License-Identifier: Apache-2.0
"""``POST /preview`` of a service that runs in this process."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.settings import Settings

KNOT = "examples/knot.ply"


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service whose engine is ready, with previews of at most 2,000 points."""
    folder = tmp_path_factory.mktemp("preview")
    settings = Settings(engine="inline", workers=1, spool_dir=folder, preview_points=2000)
    ready = threading.Event()
    with TestClient(create_app(settings, on_ready=ready.set)) as client:
        assert ready.wait(120)
        yield client


def test_a_mesh(client: TestClient, root: Path) -> None:
    """The answer is a PLY file with faces, made of at most as many points as the setting says."""
    answer = client.post("/preview", content=(root / KNOT).read_bytes())
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/ply"
    assert answer.headers["pugeo-points-in"] == "4000"
    assert answer.headers["pugeo-points-out"] == "2000"
    assert "surface;dur=" in answer.headers["server-timing"]
    assert b"element face " in answer.content[:400]


@pytest.mark.parametrize(
    ("content", "query", "status", "code"),
    [
        (b"", "", 400, "empty_body"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "", 415, "unsupported_format"),
        (b"0 0 0\n1 0 0\n0 1 0\n", "", 422, "too_few_points"),
        (b"\n".join(b"%d 0 0" % n for n in range(50)), "", 422, "collinear_points"),
        (b"\n".join(b"nan 0 0" for n in range(50)), "", 422, "too_few_points"),
        (b"0 0 0\n" * 50, "", 422, "too_few_points"),
        (b"0 0 0\n", "?R=2", 422, "bad_option"),
    ],
)
def test_refusals(client: TestClient, content: bytes, query: str, status: int, code: str) -> None:
    """Bad input is refused as /upsample refuses it; there are no options."""
    answer = client.post(f"/preview{query}", content=content)
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text


def test_without_the_library(
    client: TestClient, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service without the library says so, and that trying again does not help."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    answer = client.post("/preview", content=(root / KNOT).read_bytes())
    assert (answer.status_code, answer.json()["code"]) == (501, "no_surfaces")
    assert answer.json()["retryable"] is False
