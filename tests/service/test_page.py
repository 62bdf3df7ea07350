# SPDX-License-Identifier: Apache-2.0
"""The page comes with the service, needs nobody else's server, and no key."""

import gzip
import re
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.keys import parse
from pugeo_service.routes.page import STATIC
from pugeo_service.settings import Settings

_MOST_BYTES = 250_000


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    """A service with keys, whose engine never starts."""
    keys = parse([f"tester:{'0' * 64}"])
    return TestClient(create_app(Settings(engine="inline", spool_dir=tmp_path, api_keys=keys)))


def test_everything_it_loads_is_here(client: TestClient) -> None:
    """Each file that the page names is served without a key, with its type, at a relative path."""
    page = client.get("/")
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["cache-control"] == "no-cache"
    loaded = re.findall(r'(?:src|href)="(\./[^"]+)"', page.text)
    assert len(loaded) >= 3
    kinds = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
    for address in loaded:
        answer = client.get("/" + address.removeprefix("./"))
        assert answer.status_code == 200, address
        assert answer.headers["content-type"].startswith(kinds[address.rsplit(".")[-1]])
        assert "max-age" in answer.headers["cache-control"]
    assert not re.findall(r'(?:src|href)="(?:/|https?:)', page.text)


def test_examples_are_served(client: TestClient, root: Path) -> None:
    """The examples of the page are those of the repository."""
    for name in ("knot.ply", "block.ply"):
        assert client.get(f"/assets/{name}").content == (root / "examples" / name).read_bytes()


def test_its_policy_lets_nothing_else_in(client: TestClient) -> None:
    """Page and scripts may load from here alone, and nobody may frame the page."""
    worker = next((STATIC / "assets").glob("worker-*.js"))
    for address in ("/", f"/assets/{worker.name}"):
        policy = client.get(address).headers["content-security-policy"]
        assert "default-src 'self';" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy


def test_what_it_does_not_serve(client: TestClient) -> None:
    """Only the files of the page are served, and no way leads to others."""
    for name in ("nothing.js", "..%2findex.html", "%2e%2e/index.html", "../../app.py"):
        assert client.get(f"/assets/{name}").status_code in {401, 404}


def test_it_is_small() -> None:
    """Scripts, styles and the page itself stay below 250 KB when compressed."""
    files = [path for path in STATIC.rglob("*") if path.is_file() and path.suffix != ".ply"]
    assert len(files) >= 4
    assert sum(len(gzip.compress(path.read_bytes())) for path in files) < _MOST_BYTES
