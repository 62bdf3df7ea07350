# SPDX-License-Identifier: Apache-2.0
"""HEAD, and names in queries, on every route."""

import asyncio
from typing import Any

import httpx2
import pytest

from pugeo_service.app import create_app
from pugeo_service.settings import Settings

GET = ["/", "/docs", "/openapi.json", "/models", "/models/standard", "/health", "/health/live"]


def ask(method: str, path: str) -> Any:
    """Send a request to an application that was not started."""
    app = create_app(Settings(engine="inline"))

    async def sent() -> Any:
        transport = httpx2.ASGITransport(app=app)
        async with httpx2.AsyncClient(transport=transport, base_url="http://test") as http:
            return await http.request(method, path)

    return asyncio.run(sent())


@pytest.mark.parametrize("path", [*GET, "/metrics", "/health/ready", "/jobs", "/nowhere"])
def test_head_is_get_without_its_body(path: str) -> None:
    """HEAD has the status and the headers of GET, and no body."""
    head, get = ask("HEAD", path), ask("GET", path)
    assert (head.status_code, head.content) == (get.status_code, b"")
    changing = {"x-request-id", "content-length"} if path == "/metrics" else {"x-request-id"}
    for name in set(get.headers) - changing:
        assert head.headers[name] == get.headers[name], name


def test_head_of_a_route_without_get() -> None:
    """A route without GET has no HEAD; those with it name both."""
    answer = ask("HEAD", "/upsample")
    assert (answer.status_code, answer.headers["allow"]) == (405, "POST")
    assert ask("PUT", "/jobs").headers["allow"] == "GET, HEAD, POST"


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("POST", "/upsample?ratio=2", ["R", "n_points"]),
        ("POST", "/jobs?ratio=2", ["R", "n_points"]),
        ("GET", "/jobs?ratio=2", ["state", "limit", "cursor"]),
        ("GET", "/jobs/x?ratio=2", []),
        ("GET", "/jobs/x/result?ratio=2", []),
        ("GET", "/jobs/x/events?ratio=2", []),
        ("DELETE", "/jobs/x?ratio=2", []),
        ("GET", "/models?ratio=2", []),
        ("HEAD", "/models/standard?ratio=2", []),
    ],
)
def test_an_unknown_option(method: str, path: str, allowed: list[str]) -> None:
    """A name that the route does not know is refused with those that it knows."""
    answer = ask(method, path)
    assert answer.status_code == 422
    if method != "HEAD":
        problem = answer.json()
        assert (problem["code"], problem["parameter"]) == ("bad_option", "ratio")
        assert problem["allowed"][: len(allowed)] == allowed


@pytest.mark.parametrize("path", ["/upsample?R=2&R=4", "/jobs?seed=1&seed=1"])
def test_an_option_given_twice(path: str) -> None:
    """A name given twice is refused: nobody knows which one counts."""
    problem = ask("POST", path).json()
    assert (problem["status"], problem["code"]) == (422, "bad_option")
    assert "is given 2 times" in problem["detail"]
