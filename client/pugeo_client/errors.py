# SPDX-License-Identifier: Apache-2.0
"""What can go wrong, as a tree to catch from.

PugeoError
|- SourceError               what was handed over cannot be sent (also a ValueError)
|- ConnectionFailedError          no answer: refused, reset, unknown host
|  `- DeadlineExceededError       the call's own `timeout` ran out (also a TimeoutError)
|- InvalidResponseError                 the answer is not what its headers promise
`- StatusError               the service answered with an error (problem+json)
   |- BadRequestError        400  the file breaks its own format
   |- UnauthorizedError      401  missing or unknown API key
   |- ForbiddenError         403
   |- NotFoundError          404
   |- NotAcceptableError     406  no such answer format
   |- ConflictError          409
   |- GoneError              410  a job was cancelled, or its result is deleted
   |- TooLargeError          413  larger than a limit of the service; `fields` names it
   |- UnsupportedFormatError 415  not a point cloud format the service reads
   |- UnprocessableError     422  an option out of range, or a cloud without a surface
   |- TooManyRequestsError   429  your share is used up; `retry_after` says for how long
   `- ServerError       5xx
      |- UnavailableError    503  queue full, draining, or no worker; `retry_after` as above
      `- ServerDeadlineError 504  the service's own deadline ran out
"""

import json
from collections.abc import Mapping
from typing import Any

__all__ = [
    "BadRequestError",
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
    """Every error that this package raises on purpose."""


class SourceError(PugeoError, ValueError):
    """What was handed over is no point cloud that can be sent."""


class ConnectionFailedError(PugeoError):
    """The service gave no answer."""


class DeadlineExceededError(ConnectionFailedError, TimeoutError):
    """The call's total ``timeout`` ran out, retries and waits between them included."""


class InvalidResponseError(PugeoError):
    """The service's answer is truncated or not of the format that its headers promise."""


class StatusError(PugeoError):
    """The service answered with an error.

    Attributes:
        status: the HTTP status.
        code: stable slug for programs, such as ``"malformed_file"``; ``"http_500"`` where the
            answer was no problem+json (a proxy's page).
        detail: a sentence for people.
        request_id: names this request in the service's log; ``None`` if it sent none.
        retryable: whether the same request may succeed later; ``None`` if it did not say.
        retry_after: seconds the service asks to wait; ``None`` if it did not say.
        fields: whatever else the problem carries: the field, the limit, the value met.
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
    """400: the bytes break the rules of their own format."""


class UnauthorizedError(StatusError):
    """401: an API key is needed, or this one is not known."""


class ForbiddenError(StatusError):
    """403: not allowed with this key."""


class NotFoundError(StatusError):
    """404: no such route, job or model."""


class NotAcceptableError(StatusError):
    """406: the service writes no such format."""


class ConflictError(StatusError):
    """409: at odds with the state of the thing asked for."""


class GoneError(StatusError):
    """410: the job was cancelled, or its result is deleted."""


class TooLargeError(StatusError):
    """413: larger than a stated limit of the service."""


class UnsupportedFormatError(StatusError):
    """415: no reader for this content."""


class UnprocessableError(StatusError):
    """422: an option out of its range, or a cloud that the method cannot treat."""


class TooManyRequestsError(StatusError):
    """429: the caller's share is used up for now."""


class ServerError(StatusError):
    """Any 5xx."""


class UnavailableError(ServerError):
    """503: the queue is full, the service is draining, or no worker is ready."""


class ServerDeadlineError(ServerError):
    """504: the service gave up within its own deadline."""


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
_KNOWN = {"type", "title", "status", "detail", "instance", "code", "request_id", "retryable"}
_PROXY_PAGE_CHARS = 200  # enough of a foreign error page to recognise who sent it


def status_error(status: int, headers: Mapping[str, str], body: bytes) -> StatusError:
    """Turn an error answer into the exception of its status.

    Never raises: a proxy's HTML page becomes an error as well as a problem+json does.

    Args:
        status: HTTP status, 300 to 599.
        headers: the answer's headers, looked up by lower-case name.
        body: the whole body.
    """
    try:
        parsed = json.loads(body)
    except ValueError:
        parsed = None
    problem: dict[str, Any] = parsed if isinstance(parsed, dict) else {}
    page = body.decode("utf-8", "replace").strip()[:_PROXY_PAGE_CHARS]
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
        retry_after=_seconds(headers.get("retry-after")),
        fields={name: value for name, value in problem.items() if name not in _KNOWN},
    )


def problem_error(problem: Mapping[str, Any]) -> StatusError:
    """Turn a problem document that came inside of another answer into its exception."""
    return status_error(int(problem["status"]), {}, json.dumps(dict(problem)).encode())


def _seconds(retry_after: str | None) -> float | None:
    """Read Retry-After's seconds form (the service sends no dates); anything else is None."""
    try:
        seconds = float(retry_after or "")
    except ValueError:
        return None
    return seconds if 0 <= seconds < float("inf") else None
