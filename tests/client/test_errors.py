# SPDX-License-Identifier: Apache-2.0
import json
import re
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest

from pugeo_client import PugeoError, errors
from pugeo_client.errors import ServerError, StatusError, status_error


def problem(status: int, **members: object) -> StatusError:
    return status_error(status, {}, json.dumps(members).encode())


@pytest.mark.parametrize(
    ("status", "name"),
    [
        (400, "BadRequestError"), (401, "UnauthorizedError"), (403, "ForbiddenError"),
        (404, "NotFoundError"), (406, "NotAcceptableError"), (409, "ConflictError"),
        (410, "GoneError"), (413, "TooLargeError"), (415, "UnsupportedFormatError"),
        (422, "UnprocessableError"), (429, "TooManyRequestsError"), (500, "ServerError"),
        (502, "ServerError"), (503, "UnavailableError"), (504, "ServerDeadlineError"),
        (307, "StatusError"), (418, "StatusError"),
    ],
)  # fmt: skip
def test_each_status_has_its_class(status: int, name: str) -> None:
    """A caller can catch a kind of error without comparing numbers."""
    error = problem(status, code="x", detail="y")
    assert type(error).__name__ == name
    assert isinstance(error, ServerError) == (status >= 500)


def test_a_problem_keeps_all_members() -> None:
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


@pytest.mark.parametrize(
    "body",
    [b"", b"<html>Bad Gateway</html>", b"[]", b'"x"', b"\xff\xfe{", b"[" * 100_000, b"1" * 5000],
)
def test_the_page_of_a_proxy_is_an_error_too(body: bytes) -> None:
    """An answer that is no problem+json gets a code, and its beginning is shown."""
    error = status_error(502, {"x-request-id": "abc"}, body)
    assert (error.code, error.request_id, error.retryable) == ("http_502", "abc", None)
    assert len(str(error)) < 300
    if b"Gateway" in body:
        assert "Bad Gateway" in error.detail


@pytest.mark.parametrize("value", ["-1", "inf", "nan", "", "soon", "Wed, 99 Oct 2026", "9" * 9999])
def test_a_retry_after_that_is_no_time(value: str) -> None:
    """A Retry-After that is neither seconds nor a date counts as none."""
    assert status_error(503, {"retry-after": value}, b"").retry_after is None


def test_retry_after_as_a_date() -> None:
    """An HTTP date counts from the Date of the answer, or from now; a past one means now."""
    headers = {
        "retry-after": "Wed, 21 Oct 2026 07:28:30 GMT",
        "date": "Wed, 21 Oct 2026 07:28:00 GMT",
    }
    assert status_error(503, headers, b"").retry_after == 30.0
    assert status_error(503, {**headers, "date": headers["retry-after"]}, b"").retry_after == 0.0
    soon = format_datetime(datetime.now(UTC) + timedelta(hours=2), usegmt=True)
    alone = status_error(503, {"retry-after": soon}, b"").retry_after
    assert alone is not None
    assert 3600 < alone <= 7200
    past = {"retry-after": "Wed, 21 Oct 2015 07:28:00 GMT"}
    assert status_error(503, past, b"").retry_after == 0.0


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
    assert all(name.endswith("Error") for name in errors.__all__)


def test_the_names_of_the_first_version_still_work() -> None:
    """Each former name is the class of today, with a DeprecationWarning that names it."""
    assert errors._RENAMED["BadAnswer"] == "InvalidResponseError"
    for old, new in errors._RENAMED.items():
        with pytest.warns(DeprecationWarning, match=rf"errors\.{old} is now {new}"):
            assert getattr(errors, old) is getattr(errors, new)
    with pytest.raises(AttributeError, match="Nothing"):
        getattr(errors, "Nothing")  # noqa: B009 - mypy would see it
