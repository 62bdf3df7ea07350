# SPDX-License-Identifier: Apache-2.0
"""Who may come in, and what browsers may do with the answers."""

import asyncio
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from pugeo_service.app import create_app
from pugeo_service.keys import Entry, hash_of
from pugeo_service.problems import MEDIA_TYPE
from pugeo_service.settings import Settings

KEY = {"Authorization": "Bearer secret"}
PAGE = "https://viewer.example"
PREFLIGHT = {
    "Origin": PAGE,
    "Access-Control-Request-Method": "POST",
    "Access-Control-Request-Headers": "authorization,content-type,prefer",
}


def client(tmp_path: Path, **settings: Any) -> TestClient:
    """A service whose engine never starts, which is enough for what comes before it."""
    app = create_app(Settings(engine="inline", spool_dir=tmp_path, **settings))
    return TestClient(app, raise_server_exceptions=False)


@pytest.fixture
def locked(tmp_path: Path) -> TestClient:
    """A service with one key, and one page that may call it."""
    keys = (Entry("ann", hash_of("secret")),)
    return client(tmp_path, api_keys=keys, cors_origins=(PAGE,))


@pytest.mark.parametrize(
    "path", ["/upsample", "/models", "/models/standard", "/metrics", "/nothing", "/docs2"]
)
def test_a_key_is_asked_for(locked: TestClient, path: str) -> None:
    """Without one, 401 says how to send it; what does not exist is not told apart."""
    response = locked.get(path)
    assert (response.status_code, response.json()["code"]) == (401, "unauthorized")
    assert response.headers["content-type"] == MEDIA_TYPE
    assert response.headers["www-authenticate"] == 'Bearer realm="pugeo"'
    assert response.json()["request_id"] == response.headers["x-request-id"]
    assert not response.json()["retryable"]
    assert "X-API-Key" in response.json()["detail"]


def test_an_unknown_key(locked: TestClient) -> None:
    """It is told apart from no key at all, and not repeated in the answer."""
    response = locked.get("/models", headers={"X-API-Key": "wrong-one"})
    assert response.status_code == 401
    assert 'error="invalid_token"' in response.headers["www-authenticate"]
    assert "wrong-one" not in response.text


def test_a_key_opens(locked: TestClient) -> None:
    """Both headers do."""
    assert locked.get("/models", headers=KEY).status_code == 200
    assert locked.get("/models", headers={"X-API-Key": "secret"}).status_code == 200


@pytest.mark.parametrize("path", ["/health", "/health/live", "/docs", "/openapi.json"])
def test_what_is_open(locked: TestClient, path: str) -> None:
    """Probes and the description of the API need no key."""
    assert locked.get(path).status_code == 200


def test_the_body_is_not_read(locked: TestClient) -> None:
    """Whoever has no key cannot make the service take a byte in."""
    messages: list[Any] = []

    async def receive() -> Any:
        messages.append("asked")
        return {"type": "http.request", "body": b"x" * 10, "more_body": True}

    async def send(message: Any) -> None:
        messages.append(message["type"])

    scope = {
        "type": "http", "method": "POST", "path": "/upsample", "query_string": b"", "headers": [],
        "raw_path": b"/upsample", "root_path": "", "scheme": "http", "http_version": "1.1",
    }  # fmt: skip

    async def exchange() -> None:
        await locked.app(scope, receive, send)

    asyncio.run(exchange())
    assert messages == ["http.response.start", "http.response.body"]


def test_refusals_are_counted(locked: TestClient) -> None:
    """The dashboard sees who knocks without a key."""
    locked.get("/models")
    locked.get("/models")
    metrics = locked.get("/metrics", headers=KEY).text
    assert 'pugeo_rejected_total{reason="unauthorized"} 2.0' in metrics


def test_without_keys_everybody_may_come_in(tmp_path: Path) -> None:
    """Keys are an option."""
    assert client(tmp_path).get("/models").status_code == 200


def test_preflights_need_no_key(locked: TestClient) -> None:
    """A browser asks before it sends, and cannot send a key with that question."""
    response = locked.options("/upsample", headers=PREFLIGHT)
    assert response.status_code == 200
    assert response.headers["access-control-allow-origin"] == PAGE
    allowed = response.headers["access-control-allow-headers"].lower()
    assert {"authorization", "x-api-key", "prefer"} <= set(allowed.split(", "))


def test_pages_see_answers_and_refusals(locked: TestClient) -> None:
    """The one page may read bodies and our headers, also of a 401; others may not."""
    response = locked.get("/models", headers={"Origin": PAGE})
    assert (response.status_code, response.headers["access-control-allow-origin"]) == (401, PAGE)
    assert "Retry-After" in response.headers["access-control-expose-headers"]
    assert "access-control-allow-credentials" not in response.headers
    other = locked.get("/models", headers={**KEY, "Origin": "https://evil.example"})
    assert "access-control-allow-origin" not in other.headers


def test_cors_is_off_by_default(tmp_path: Path) -> None:
    """No page of another origin may do anything unless somebody says so."""
    plain = client(tmp_path)
    assert plain.options("/upsample", headers=PREFLIGHT).status_code == 405
    headers = plain.get("/models", headers={"Origin": PAGE}).headers
    assert not [name for name in headers if name.startswith("access-control")]


def test_every_page_may(tmp_path: Path) -> None:
    """An asterisk lets all pages in; without cookies that exposes nothing."""
    response = client(tmp_path, cors_origins="*").get("/models", headers={"Origin": PAGE})
    assert response.headers["access-control-allow-origin"] == "*"


@pytest.mark.parametrize("origin", ["viewer.example", "https://viewer.example/", "https://*.ex"])
def test_wrong_origins(tmp_path: Path, origin: str) -> None:
    """What can never match an Origin header is refused at the start."""
    with pytest.raises(ValueError, match="no origin"):
        client(tmp_path, cors_origins=f"{PAGE}, {origin}")


@pytest.mark.parametrize("path", ["/health", "/models", "/nothing", "/docs", "/metrics"])
def test_every_answer_is_hardened(tmp_path: Path, path: str) -> None:
    """No guessing of types, no frames, no referrer, nothing kept by caches."""
    headers = client(tmp_path).get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == "no-store"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "default-src 'none'" in headers["content-security-policy"]


def test_metrics_move_to_their_port(tmp_path: Path) -> None:
    """Where they have one, the main port has none."""
    assert client(tmp_path).get("/metrics").status_code == 200
    assert client(tmp_path, metrics_port=9100).get("/metrics").status_code == 404
