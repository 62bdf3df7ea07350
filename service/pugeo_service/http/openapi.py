# SPDX-License-Identifier: Apache-2.0
"""The OpenAPI document: FastAPI's, completed by keys, request ids and problems of all routes."""

from typing import Any

from fastapi import FastAPI

from pugeo_service.http.auth import is_open
from pugeo_service.problems import MEDIA_TYPE, PROBLEM_SCHEMA, problem_responses

__all__ = ["install"]

_PROBLEM = {"$ref": "#/components/schemas/Problem"}
# Either scheme if the service has keys; none otherwise.
_SCHEMES = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "Authorization: Bearer KEY"},
    "key": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}
_SECURITY: list[dict[str, list[str]]] = [{}, {"bearer": []}, {"key": []}]
_REQUEST_ID = {
    "name": "X-Request-ID",
    "in": "header",
    "required": False,
    # No pattern in the schema: an id of another form is not an error, but is replaced.
    "description": "Id of this request in logs and problems: up to 128 letters, digits and any "
    "of ._:- ; another id is replaced by a random one.",
    "schema": {"type": "string"},
}


def install(app: FastAPI) -> None:
    """Make ``app.openapi()`` return the completed document, which is built once."""
    build = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(build())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _complete(document: dict[str, Any]) -> None:
    """Add keys, ids and problems in place."""
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    # FastAPI's own form of a 422, which this service never sends.
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    schemas["Problem"] = PROBLEM_SCHEMA
    components["securitySchemes"] = _SCHEMES
    for path, operations in document["paths"].items():
        for operation in operations.values():
            operation.setdefault("parameters", []).append(_REQUEST_ID)
            if not is_open(path):
                operation["security"] = _SECURITY
                operation["responses"] |= {
                    str(status): answer for status, answer in problem_responses(401).items()
                }
            for status, answer in operation["responses"].items():
                if int(status) >= 400:
                    answer["content"] = {MEDIA_TYPE: {"schema": _PROBLEM}}
            operation["responses"] = dict(sorted(operation["responses"].items()))
