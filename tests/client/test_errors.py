# SPDX-License-Identifier: Apache-2.0
import json
import re

import pytest

from pugeo_client import PugeoError, errors
from pugeo_client.errors import ServerError, StatusError, status_error


def problem(status: int, **members: object) -> StatusError:
    return status_error(status, {}, json.dumps(members).encode())


@pytest.mark.parametrize(
    ("status", "name"),
    [
        (400, "BadRequest"), (401, "Unauthorized"), (403, "Forbidden"), (404, "NotFound"),
        (406, "NotAcceptable"), (409, "Conflict"), (413, "TooLarge"), (415, "UnsupportedFormat"),
        (422, "Unprocessable"), (429, "TooManyRequests"), (500, "ServerError"),
        (502, "ServerError"), (503, "Unavailable"), (504, "ServerDeadline"),
        (307, "StatusError"), (418, "StatusError"),
    ],
)  # fmt: skip
def test_each_status_has_its_class(status: int, name: str) -> None:
    """A caller can catch a kind of error without comparing numbers."""
    error = problem(status, code="x", detail="y")
    assert type(error).__name__ == name
    assert isinstance(error, ServerError) == (status >= 500)


def test_a_problem_keeps_all_it_says() -> None:
    """Every member of a problem+json is an attribute or one of the fields."""
    body = {
        "type": "urn:pugeo:problem:limit_exceeded",
        "title": "Content Too Large",
        "status": 413,
        "detail": "4000000000 points are more than 5000000.",
        "instance": "/upsample",
        "code": "limit_exceeded",
        "request_id": "abc",
        "retryable": False,
        "limit": 5_000_000,
    }
    error = status_error(413, {"retry-after": "7"}, json.dumps(body).encode())
    assert (error.status, error.code, error.detail) == (413, body["code"], body["detail"])
    assert (error.request_id, error.retryable, error.retry_after) == ("abc", False, 7.0)
    assert error.fields == {"limit": 5_000_000}
    assert str(error) == f"413 limit_exceeded: {body['detail']} [request abc]"


@pytest.mark.parametrize("body", [b"", b"<html>Bad Gateway</html>", b"[]", b'"x"', b"\xff\xfe{"])
def test_a_foreign_page_is_an_error_too(body: bytes) -> None:
    """A proxy's answer gets a code, and its words are shown."""
    error = status_error(502, {"x-request-id": "abc"}, body)
    assert (error.code, error.request_id, error.retryable) == ("http_502", "abc", None)
    if b"Gateway" in body:
        assert "Bad Gateway" in error.detail


@pytest.mark.parametrize("value", ["Wed, 21 Oct 2026 07:28:00 GMT", "-1", "inf", "nan", "", "soon"])
def test_only_seconds_are_a_wait(value: str) -> None:
    """A Retry-After that gives no sensible seconds counts as none."""
    assert status_error(503, {"retry-after": value}, b"").retry_after is None


def test_the_tree_is_the_one_drawn() -> None:
    """Every exported error stands in the drawing, indented under its base class."""
    assert errors.__doc__ is not None
    stack: list[str] = []
    seen: set[str] = set()
    for line in errors.__doc__.splitlines():
        drawn = re.match(r"((?:[|` ][- ] )*)([A-Z]\w+)", line)
        if drawn is None or drawn[2] not in errors.__all__:
            continue
        depth = len(drawn[1]) // 3
        base = getattr(errors, stack[depth - 1]) if depth else Exception
        assert getattr(errors, drawn[2]).__mro__[1] is base, line
        stack[depth:] = [drawn[2]]
        seen.add(drawn[2])
    assert seen == set(errors.__all__)
    assert all(issubclass(getattr(errors, name), PugeoError) for name in errors.__all__)
