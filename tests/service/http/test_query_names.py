# SPDX-License-Identifier: Apache-2.0
"""Names in the query that a route does not have are refused."""

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from pugeo_service.app import create_app, create_metrics_app, create_service
from pugeo_service.models import Models
from pugeo_service.settings import Settings


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    """A service that is not started."""
    return TestClient(create_app(Settings(engine="inline", spool_dir=tmp_path)))


@pytest.mark.parametrize("method", ["GET", "HEAD"])
@pytest.mark.parametrize(
    "path",
    [
        "/health", "/health/live", "/health/ready", "/metrics", "/models", "/docs", "/openapi.json",
        "/docs/start.js",
    ],
)  # fmt: skip
def test_a_route_without_options(client: TestClient, path: str, method: str) -> None:
    """A route without options refuses each name, and answers without one."""
    answer = client.request(method, f"{path}?verbose=1")
    assert answer.status_code == 422
    if method == "GET":
        problem = answer.json()
        assert (problem["code"], problem["parameter"]) == ("bad_option", "verbose")
        assert "this route has none" in problem["detail"]
    # No worker is ready in a service that is not started.
    assert client.request(method, path).status_code == (503 if path == "/health/ready" else 200)


def test_every_route_has_the_rule(client: TestClient) -> None:
    """No route answers a request whose query has a name that nobody knows."""
    document = client.get("/openapi.json").json()
    pages = ("/docs", "/docs/{name}", "/openapi.json")
    paths = document["paths"] | dict.fromkeys(pages, ("get",))
    assert len(paths) > 12
    for path, methods in paths.items():
        for method in methods:
            answer = client.request(method, path.replace("{name}", "standard") + "?nobody=1")
            assert (answer.status_code, answer.json()["code"]) == (422, "bad_option"), path


def test_the_page(client: TestClient) -> None:
    """The page takes names that programs append to links."""
    for path in ("/", "/assets/icon.svg"):
        assert client.get(f"{path}?utm_source=mail").status_code == 200


def test_the_port_of_metrics(tmp_path: Path) -> None:
    """The separate port of metrics has one route, which refuses what the main port refuses."""
    settings = Settings(engine="inline", spool_dir=tmp_path)
    client = TestClient(create_metrics_app(create_service(settings, Models(settings))))
    for query in ("verbose=1", "name[]=pugeo_workers", "a=1&a=2"):
        answer = client.get(f"/metrics?{query}")
        assert (answer.status_code, answer.json()["code"]) == (422, "bad_option")
        assert client.head(f"/metrics?{query}").status_code == 422
    told = client.get("/metrics")
    assert "pugeo_workers{" in told.text
    assert told.headers["x-content-type-options"] == "nosniff"
    assert client.head("/metrics").status_code == 200
    assert client.post("/metrics").headers["allow"] == "GET, HEAD"
    lost = client.get("/jobs")
    assert (lost.status_code, lost.json()["detail"]) == (
        404,
        "There is no route /jobs; this port has /metrics.",
    )
