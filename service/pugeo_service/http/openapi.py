# SPDX-License-Identifier: Apache-2.0
"""The OpenAPI document: FastAPI's, with what holds for every route said once.

``python -m pugeo_service.http.openapi`` prints it.
"""

import json
import sys
from typing import Any

from fastapi import FastAPI

from pugeo_service.http.auth import is_open
from pugeo_service.problems import MEDIA_TYPE, PROBLEM_SCHEMA, problem_responses

__all__ = ["install"]

_PROBLEM = {"$ref": "#/components/schemas/ProblemError"}
# Either of them where the service has keys, none where it has not.
_SCHEMES = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "Authorization: Bearer KEY"},
    "key": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}
_SECURITY: list[dict[str, list[str]]] = [{}, {"bearer": []}, {"key": []}]
_REQUEST_ID = {
    "name": "X-Request-ID",
    "in": "header",
    "required": False,
    # No pattern in the schema: another id is no mistake, it is only not used.
    "description": "What logs and problems are to call this request: up to 128 letters, digits "
    "and any of ._:- ; one is made up otherwise.",
    "schema": {"type": "string"},
}


def install(app: FastAPI) -> None:
    """Make ``app.openapi()`` return the document, made once."""
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            _complete(plain())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _complete(document: dict[str, Any]) -> None:
    """Add keys, ids and problems in place."""
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    # FastAPI's own form of a 422, which no answer of this service has.
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


def _main() -> None:
    from pugeo_service.app import create_app
    from pugeo_service.settings import Settings

    # Not what this environment may set: the document is the same for everybody.
    app = create_app(Settings(metrics_port=None, api_keys=None, api_keys_file=None))
    sys.stdout.write(json.dumps(app.openapi(), indent=2, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    _main()
