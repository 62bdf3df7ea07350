# SPDX-License-Identifier: Apache-2.0
"""Errors as problem documents of RFC 9457."""

import json
from typing import Any

import numpy as np
import orjson
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from pugeo_model.errors import (
    BadOptionError,
    CloudError,
    LimitExceededError,
    MalformedFileError,
    UnsupportedFormatError,
    UntreatableCloudError,
)
from pugeo_service import problems
from pugeo_service.problems import MEDIA_TYPE, PROBLEM_SCHEMA, ProblemError

SCOPE = {"path": "/upsample", "state": {"request_id": "abc"}}


def document(problem: ProblemError) -> dict[str, Any]:
    """Members of the problem document."""
    response = problem.response(SCOPE)
    assert response.media_type == MEDIA_TYPE
    parsed: dict[str, Any] = orjson.loads(response.body)
    return parsed


def test_the_members() -> None:
    """A problem has all members of the schema, and its own fields."""
    found = document(ProblemError(413, "too_large", "Too large.", fields={"limit": 5, "value": 7}))
    assert set(PROBLEM_SCHEMA["required"]) < set(found)
    assert found == {
        "type": "urn:pugeo:problem:too_large",
        "title": "Request Entity Too Large",
        "status": 413,
        "detail": "Too large.",
        "instance": "/upsample",
        "code": "too_large",
        "request_id": "abc",
        "retryable": False,
        "limit": 5,
        "value": 7,
    }


def test_fields_cannot_replace_the_members() -> None:
    """A field named status does not change the status."""
    assert document(ProblemError(422, "x", "y", fields={"status": 200}))["status"] == 422


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (MalformedFileError("bad", code="truncated", expected=4), 400),
        (LimitExceededError("bad"), 413),
        (UnsupportedFormatError("bad"), 415),
        (UntreatableCloudError("bad"), 422),
        (BadOptionError("bad"), 422),
        (CloudError("bad"), 422),
    ],
)
def test_errors_of_the_model(error: CloudError, status: int) -> None:
    """Each kind has its status; code and fields are the model's."""
    found = document(ProblemError.from_cloud_error(error))
    assert (found["status"], found["code"], found["detail"]) == (status, error.code, "bad")
    assert not found["retryable"]
    assert {key: found[key] for key in error.fields} == error.fields


@pytest.mark.parametrize(("status", "retryable"), [(408, True), (503, True), (504, True)])
def test_what_may_be_tried_again(status: int, *, retryable: bool) -> None:
    """Errors of the service are retryable."""
    assert document(ProblemError(status, "x", "y"))["retryable"] is retryable


def test_retry_after_is_a_whole_number() -> None:
    """The header has whole seconds, at least one."""
    headers = [ProblemError(503, "x", "y", retry_after=wait).headers for wait in (0.0, 1.2)]
    assert [h["Retry-After"] for h in headers] == ["1", "2"]


@pytest.fixture
def client() -> TestClient:
    """An application with the handlers only."""
    app = FastAPI(redirect_slashes=False)
    problems.install(app)

    @app.get("/number")
    async def number(value: int) -> int:
        return value

    @app.delete("/number")
    async def forget() -> None:
        return None

    return TestClient(app)


def test_unknown_route(client: TestClient) -> None:
    """404 of the framework is a problem."""
    response = client.get("/nothing")
    assert (response.status_code, response.json()["code"]) == (404, "not_found")
    assert response.headers["content-type"] == MEDIA_TYPE


def test_wrong_method(client: TestClient) -> None:
    """405 of the framework is a problem, and its header names the methods of all the routes."""
    response = client.post("/number")
    assert (response.status_code, response.json()["code"]) == (405, "method_not_allowed")
    assert response.headers["allow"] == "DELETE, GET, HEAD"


def test_invalid_parameter(client: TestClient) -> None:
    """422 of the framework names the parameter and its value."""
    found = client.get("/number?value=abc").json()
    assert (found["status"], found["parameter"], found["value"]) == (422, "value", "abc")
    assert found["detail"].startswith("value=abc: ")


def test_an_internal_error_says_nothing() -> None:
    """The response to an unexpected error has an id but no detail."""
    response = problems.internal_error(SCOPE)
    found = orjson.loads(response.body)
    assert (response.status_code, found["code"], found["request_id"]) == (
        500,
        "internal_error",
        "abc",
    )


def test_numbers_of_any_kind() -> None:
    """Numbers of any size, numpy values and NaN can be fields."""
    fields = {"value": 10**300, "limit": np.int64(7), "mean": float("nan"), "at": np.zeros(2)}
    response = ProblemError(422, "bad_option", "No.", fields=fields).response(SCOPE)
    found = json.loads(bytes(response.body))
    assert found["value"] == 10**300
    assert (found["limit"], found["mean"], found["at"]) == (7, None, [0.0, 0.0])
