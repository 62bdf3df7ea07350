# SPDX-License-Identifier: Apache-2.0
"""Errors as problem documents, ``application/problem+json`` (RFC 9457)."""

import math
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pugeo_model.errors import (
    BadOptionError,
    CloudError,
    LimitExceededError,
    MalformedFileError,
    UnsupportedFormatError,
    UntreatableCloudError,
)
from pugeo_service.json_encoding import encode_json

__all__ = [
    "MEDIA_TYPE",
    "NO_SETTING",
    "PROBLEM_SCHEMA",
    "ProblemError",
    "bug",
    "draining",
    "install",
    "internal_error",
    "problem_responses",
]

MEDIA_TYPE = "application/problem+json"

_STATUS: dict[type[CloudError], int] = {
    MalformedFileError: 400,
    LimitExceededError: 413,
    UnsupportedFormatError: 415,
    UntreatableCloudError: 422,
    BadOptionError: 422,
}
_CODE = {
    400: "bad_request",
    401: "unauthorized",
    404: "not_found",
    405: "method_not_allowed",
    413: "body_too_large",
    422: "bad_option",
}
_RETRYABLE = frozenset({408, 429, 503, 504})
# Limit in an error of the model -> the setting that raises it. Other limits have none.
_SETTINGS = {
    "max_points": "PUGEO_MAX_POINTS",
    "max_bytes": "PUGEO_MAX_CLOUD_BYTES",
    "max_output_points": "PUGEO_MAX_OUTPUT_POINTS",
    "max_output_bytes": "PUGEO_MAX_OUTPUT_BYTES",
    "worker_memory": "PUGEO_WORKER_MEMORY",
}

NO_SETTING = "No setting of the service changes this limit."

PROBLEM_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["type", "title", "status", "detail", "code", "request_id", "retryable"],
    "properties": {
        "type": {"type": "string", "format": "uri"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "instance": {"type": "string"},
        "code": {"type": "string", "description": "stable identifier for programs"},
        "request_id": {"type": "string"},
        "retryable": {"type": "boolean", "description": "the same request may succeed later"},
    },
    "additionalProperties": True,
}


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI ``responses`` for problems of these statuses."""
    content = {MEDIA_TYPE: {"schema": PROBLEM_SCHEMA}}
    return {
        status: {"description": HTTPStatus(status).phrase, "content": content}
        for status in statuses
    }


class ProblemError(Exception):
    """An error with the content of its problem document.

    Args:
        status: HTTP status, 400 to 599.
        code: stable identifier for programs.
        detail: the cause and the remedy, for a person.
        retryable: the same request may succeed later; by default it depends on the status.
        retry_after: seconds, for the ``Retry-After`` header.
        headers: further headers of the answer.
        fields: further members of the document (limits, values).
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        *,
        retryable: bool | None = None,
        retry_after: float | None = None,
        headers: Mapping[str, str] | None = None,
        fields: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.retryable = status in _RETRYABLE if retryable is None else retryable
        self.headers = dict(headers or {})
        self.fields = dict(fields or {})
        if retry_after is not None:
            self.headers["Retry-After"] = str(max(1, math.ceil(retry_after)))

    @classmethod
    def from_cloud_error(cls, error: CloudError) -> "ProblemError":
        """Convert an error of the model."""
        status = next((_STATUS[kind] for kind in type(error).__mro__ if kind in _STATUS), 422)
        name = error.fields.get("name", "")
        setting = _SETTINGS.get(name)
        if setting is None:
            fixed = isinstance(error, LimitExceededError) and name
            detail = f"{error.message} {NO_SETTING}" if fixed else error.message
            return cls(status, error.code, detail, fields=error.fields)
        detail = f"{error.message} The service allows more with a larger {setting}."
        return cls(status, error.code, detail, fields={**error.fields, "setting": setting})

    def members(self, instance: str, request_id: str) -> dict[str, Any]:
        """Return the members of the problem document.

        Args:
            instance: path of the request or of the job.
            request_id: id of the request in the log.
        """
        # Standard members last: a field of the same name must not replace them.
        return {
            **self.fields,
            "type": f"urn:pugeo:problem:{self.code}",
            "title": HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
            "instance": instance,
            "code": self.code,
            "request_id": request_id,
            "retryable": self.retryable,
        }

    def response(self, scope: Mapping[str, Any]) -> Response:
        """Build the response to the request of an ASGI ``scope``."""
        members = self.members(scope.get("path", ""), scope.get("state", {}).get("request_id", ""))
        return Response(
            encode_json(members), self.status, headers=self.headers, media_type=MEDIA_TYPE
        )


def bug() -> ProblemError:
    """Return the problem for an unexpected error; it reveals only the id in the log."""
    detail = "Unexpected error of the service; its log has the cause under this request_id."
    return ProblemError(500, "internal_error", detail, retryable=False)


def draining() -> ProblemError:
    """Return the problem for requests that a service which shuts down does not finish."""
    detail = "The service is shutting down; another one may take the request."
    return ProblemError(503, "draining", detail, retry_after=5)


def internal_error(scope: Mapping[str, Any]) -> Response:
    """Build the response to a request that caused an unexpected error."""
    return bug().response(scope)


def install(app: FastAPI, document: str | None = None) -> None:
    """Register handlers that turn all errors of routes and framework into problems.

    Args:
        app: the application.
        document: path of its route that describes all others, if it has one.
    """

    @app.exception_handler(ProblemError)
    async def on_problem(request: Request, error: ProblemError) -> Response:
        return error.response(request.scope)

    @app.exception_handler(CloudError)
    async def on_cloud_error(request: Request, error: CloudError) -> Response:
        return ProblemError.from_cloud_error(error).response(request.scope)

    @app.exception_handler(RequestValidationError)
    async def on_validation(request: Request, error: RequestValidationError) -> Response:
        return _invalid(error).response(request.scope)

    @app.exception_handler(HTTPException)
    async def on_http(request: Request, error: HTTPException) -> Response:
        code = _CODE.get(error.status_code, "http_error")
        detail, headers = error.detail, dict(error.headers or {})
        if error.status_code == 404:
            if document is not None:
                others = f"{document} lists all routes"
            else:
                others = f"this port has {', '.join(app.openapi()['paths'])}"
            detail = f"There is no route {request.url.path}; {others}."
        elif error.status_code == 405:
            detail = (
                f"{request.url.path} does not support {request.method}; see Allow for its methods."
            )
            headers["Allow"] = _allowed(app, request.scope, headers.get("Allow", ""))
        problem = ProblemError(error.status_code, code, detail, headers=headers)
        return problem.response(request.scope)


def _allowed(app: FastAPI, scope: Mapping[str, Any], found: str) -> str:
    """Return all methods of a path; the framework reports those of one route only."""
    path = getattr(scope.get("route"), "path", None)
    described = {method.upper() for method in app.openapi()["paths"].get(path, ())}
    methods = {*described, *found.replace(",", " ").split()}
    # HEAD is answered wherever GET is: see `http.head_requests`.
    return ", ".join(sorted(methods | {"HEAD"} if "GET" in methods else methods))


def _invalid(error: RequestValidationError) -> ProblemError:
    errors = [_entry(entry) for entry in error.errors()]
    first = errors[0]
    name, value = first.get("parameter"), first.get("value")
    detail = f"{name}={value}: {first['message']}" if value is not None else first["message"]
    return ProblemError(422, "bad_option", detail, fields={**first, "errors": errors})


def _entry(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return message, parameter, value and limit of one validation error, if present."""
    found: dict[str, Any] = {"message": entry["msg"].removeprefix("Value error, ")}
    path = entry["loc"][1:]
    if path:
        found["parameter"] = ".".join(str(part) for part in path)
        found["value"] = str(entry.get("input"))[:80]
    context = entry.get("ctx", {})
    found.update({key: context[key] for key in ("parameter", "allowed") if key in context})
    limits = [context[key] for key in ("ge", "gt", "le", "lt") if key in context]
    return {**found, "limit": limits[0]} if limits else found
