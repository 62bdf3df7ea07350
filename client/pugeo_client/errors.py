# SPDX-License-Identifier: Apache-2.0
"""The errors of this package, as a tree to catch from.

PugeoError
|- SourceError               the input or an option cannot be sent (also a ValueError)
|- ConfigurationError        unusable address, API key, proxy or certificate (also a ValueError)
|- ConnectionFailedError     no answer: refused, reset, unknown host
|  `- DeadlineExceededError  the `timeout` of the call ran out (also a TimeoutError)
|- InvalidResponseError      the answer is not what its headers promise
`- StatusError               the service answered with an error (problem+json)
   |- BadRequestError        400  the file breaks the rules of its own format
   |- UnauthorizedError      401  missing or unknown API key
   |- ForbiddenError         403  not allowed with this API key
   |- NotFoundError          404  no such route, job or model
   |- NotAcceptableError     406  no such output format
   |- ConflictError          409  not possible in the present state of the job
   |- GoneError              410  the job was cancelled, or its result is deleted
   |- TooLargeError          413  larger than a limit of the service; `fields` names it
   |- UnsupportedFormatError 415  not a point cloud format that the service reads
   |- UnprocessableError     422  an option out of range, or a cloud without a surface
   |- TooManyRequestsError   429  your share is used up; `retry_after` says for how long
   `- ServerError            5xx
      |- UnavailableError    503  queue full, draining, or no worker; `retry_after` as above
      `- ServerDeadlineError 504  the time limit of the service ran out
"""

import json
import warnings
from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

__all__ = [
    "BadRequestError",
    "ConfigurationError",
    "ConflictError",
    "ConnectionFailedError",
    "DeadlineExceededError",
    "ForbiddenError",
    "GoneError",
    "InvalidResponseError",
    "NotAcceptableError",
    "NotFoundError",
    "PugeoError",
    "ServerDeadlineError",
    "ServerError",
    "SourceError",
    "StatusError",
    "TooLargeError",
    "TooManyRequestsError",
    "UnauthorizedError",
    "UnavailableError",
    "UnprocessableError",
    "UnsupportedFormatError",
]


class PugeoError(Exception):
    """Base class of every error that this package raises on purpose."""


class SourceError(PugeoError, ValueError):
    """The input is no point cloud that can be sent, or an option has no valid value."""


class ConfigurationError(PugeoError, ValueError):
    """The address, the API key, a proxy or a certificate setting cannot be used."""


class ConnectionFailedError(PugeoError):
    """The service gave no answer."""


class DeadlineExceededError(ConnectionFailedError, TimeoutError):
    """The ``timeout`` of the call ran out, retries and the waits between them included."""


class InvalidResponseError(PugeoError):
    """The answer is truncated, or not of the format that its headers promise."""


class StatusError(PugeoError):
    """The service answered with an error.

    Attributes:
        status: the HTTP status.
        code: stable identifier for programs, such as ``"malformed_file"``; ``"http_500"`` where
            the answer was no problem+json (the error page of a proxy).
        detail: explanation for a person.
        request_id: id of this request in the log of the service; ``None`` if it sent none.
        retryable: whether the same request may succeed later; ``None`` if it did not say.
        retry_after: seconds the service asks to wait; ``None`` if it did not say.
        fields: further members of the problem: the parameter, its value, the limit.
    """

    def __init__(
        self,
        status: int,
        *,
        code: str,
        detail: str,
        request_id: str | None = None,
        retryable: bool | None = None,
        retry_after: float | None = None,
        fields: Mapping[str, Any] | None = None,
    ) -> None:
        named = f" [request {request_id}]" if request_id else ""
        super().__init__(f"{status} {code}: {detail}{named}")
        self.status = status
        self.code = code
        self.detail = detail
        self.request_id = request_id
        self.retryable = retryable
        self.retry_after = retry_after
        self.fields: dict[str, Any] = dict(fields or {})


class BadRequestError(StatusError):
    """400: the file breaks the rules of its own format."""


class UnauthorizedError(StatusError):
    """401: an API key is missing or unknown."""


class ForbiddenError(StatusError):
    """403: not allowed with this API key."""


class NotFoundError(StatusError):
    """404: no such route, job or model."""


class NotAcceptableError(StatusError):
    """406: the service writes no such output format."""


class ConflictError(StatusError):
    """409: not possible in the present state of the job."""


class GoneError(StatusError):
    """410: the job was cancelled, or its result is deleted."""


class TooLargeError(StatusError):
    """413: larger than a limit of the service; ``fields`` names it."""


class UnsupportedFormatError(StatusError):
    """415: not a point cloud format that the service reads."""


class UnprocessableError(StatusError):
    """422: an option out of range, or a cloud without a surface."""


class TooManyRequestsError(StatusError):
    """429: the share of this API key is used up for now."""


class ServerError(StatusError):
    """5xx: the service failed."""


class UnavailableError(ServerError):
    """503: the queue is full, the service is shutting down, or no worker is ready."""


class ServerDeadlineError(ServerError):
    """504: the time limit of the service ran out."""


_BY_STATUS: dict[int, type[StatusError]] = {
    400: BadRequestError,
    401: UnauthorizedError,
    403: ForbiddenError,
    404: NotFoundError,
    406: NotAcceptableError,
    409: ConflictError,
    410: GoneError,
    413: TooLargeError,
    415: UnsupportedFormatError,
    422: UnprocessableError,
    429: TooManyRequestsError,
    503: UnavailableError,
    504: ServerDeadlineError,
}
_STANDARD_MEMBERS = {
    "type",
    "title",
    "status",
    "detail",
    "instance",
    "code",
    "request_id",
    "retryable",
}
_MAX_DATE_CHARS = 64
_MAX_PAGE_CHARS = 200  # enough of an error page to recognise the proxy that sent it


def status_error(status: int, headers: Mapping[str, str], body: bytes) -> StatusError:
    """Turn an error answer into the exception of its status.

    Never raises: the HTML page of a proxy becomes an exception too.

    Args:
        status: HTTP status, 300 to 599.
        headers: the answer's headers, looked up by lower-case name.
        body: the whole body.
    """
    try:
        parsed = json.loads(body)
    except (ValueError, RecursionError):
        parsed = None
    problem: dict[str, Any] = parsed if isinstance(parsed, dict) else {}
    page = body.decode("utf-8", "replace").strip()[:_MAX_PAGE_CHARS]
    detail = problem.get("detail") or problem.get("title") or page or "no further detail"
    retryable = problem.get("retryable")
    request_id = problem.get("request_id") or headers.get("x-request-id")
    kind = _BY_STATUS.get(status, ServerError if status >= 500 else StatusError)
    return kind(
        status,
        code=str(problem.get("code") or f"http_{status}"),
        detail=str(detail),
        request_id=None if request_id is None else str(request_id),
        retryable=retryable if isinstance(retryable, bool) else None,
        retry_after=_seconds(headers),
        fields={name: value for name, value in problem.items() if name not in _STANDARD_MEMBERS},
    )


def problem_error(problem: Mapping[str, Any]) -> StatusError:
    """Turn a problem document, as a failed job carries it, into its exception."""
    return status_error(int(problem["status"]), {}, json.dumps(dict(problem)).encode())


def _seconds(headers: Mapping[str, str]) -> float | None:
    """Read Retry-After, in seconds or as an HTTP date (RFC 9110); None if it is neither.

    A date counts from the ``Date`` of the answer, so that a wrong clock here does no harm.
    """
    value = headers.get("retry-after", "")
    try:
        seconds = float(value)
    except ValueError:
        until = _date(value)
        now = _date(headers.get("date", "")) or datetime.now(UTC)
        return None if until is None else max(0.0, (until - now).total_seconds())
    return seconds if 0 <= seconds < float("inf") else None


def _date(value: str) -> datetime | None:
    try:
        date = parsedate_to_datetime(value[:_MAX_DATE_CHARS])
    except (ValueError, TypeError, IndexError, OverflowError):
        return None
    return date if date.tzinfo else date.replace(tzinfo=UTC)


# Names of version 0.1.0.
_RENAMED = {
    "BadAnswer": "InvalidResponseError",
    "BadRequest": "BadRequestError",
    "Conflict": "ConflictError",
    "ConnectionFailed": "ConnectionFailedError",
    "DeadlineExceeded": "DeadlineExceededError",
    "Forbidden": "ForbiddenError",
    "Gone": "GoneError",
    "NotAcceptable": "NotAcceptableError",
    "NotFound": "NotFoundError",
    "ServerDeadline": "ServerDeadlineError",
    "TooLarge": "TooLargeError",
    "TooManyRequests": "TooManyRequestsError",
    "Unauthorized": "UnauthorizedError",
    "Unavailable": "UnavailableError",
    "Unprocessable": "UnprocessableError",
    "UnsupportedFormat": "UnsupportedFormatError",
}


def __getattr__(name: str) -> Any:
    """Return an error class by its former name, with a DeprecationWarning."""
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(
        f"pugeo_client.errors.{name} is now {_RENAMED[name]}", DeprecationWarning, stacklevel=2
    )
    return globals()[_RENAMED[name]]
