# SPDX-License-Identifier: Apache-2.0
"""Names in the query of a request: those of its route, each once."""

from collections import Counter
from typing import Any

from fastapi import Request

from pugeo_service.problems import ProblemError

__all__ = ["check_query"]


async def check_query(request: Request) -> None:
    """Refuse a query with a name that the route does not know, or with a name given twice.

    A dependency of routes, whose names are those of the OpenAPI document.

    Raises:
        ProblemError: 422.
    """
    given = Counter(name for name, _ in request.query_params.multi_items())
    if not given:
        return
    # Pages and their files are not in the document, and have no options.
    operations = request.app.openapi()["paths"].get(request.scope["route"].path, {})
    operation = operations.get(request.method.lower(), {})
    known = [each["name"] for each in operation.get("parameters", ()) if each["in"] == "query"]
    for name, count in given.items():
        short = name[:80]
        if name not in known:
            names = f"there are {', '.join(known)}" if known else "this route has none"
            raise _problem(f"there is no option {short}; {names}", short, allowed=known)
        if count > 1:
            raise _problem(f"{name} is given {count} times; give it once", name)


def _problem(message: str, parameter: str, **fields: Any) -> ProblemError:
    entry = {"message": message, "parameter": parameter, **fields}
    return ProblemError(422, "bad_option", message, fields={**entry, "errors": [entry]})
