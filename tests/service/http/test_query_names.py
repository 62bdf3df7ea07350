# SPDX-License-Identifier: Apache-2.0
"""Names in the query that a route does not have are refused."""

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.settings import Settings


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    """A service that is not started."""
    return TestClient(create_app(Settings(engine="inline", spool_dir=tmp_path)))


@pytest.mark.parametrize("method", ["GET", "HEAD"])
@pytest.mark.parametrize(
    "path", ["/health", "/health/live", "/health/ready", "/metrics", "/models"]
)
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
