# SPDX-License-Identifier: Apache-2.0
"""``GET /docs``, an interactive description of the API without files from the internet.

``GET /openapi.json`` is the same for programs.
"""

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, HTTPException, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response

__all__ = ["router"]

router = APIRouter(include_in_schema=False)

# Swagger UI (Apache-2.0) draws its icons from data URLs.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Relative addresses, so that the page works behind a proxy with a path prefix.
_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>pugeo: the API</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="docs/swagger-ui.css">
<main id="docs"></main>
<noscript>This page needs scripts; <a href="openapi.json">openapi.json</a> says the same.</noscript>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
"""
_START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  displayRequestDuration: true,
  tryItOutEnabled: true,
  validatorUrl: null,
});
"""


@dataclass(frozen=True)
class _Asset:
    media_type: str
    file: Path | None = None


def _bundled() -> Path:
    """Return the folder of Swagger UI without importing its package."""
    found = importlib.util.find_spec("fastapi_standalone_docs")
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent / "static" / "swagger"


_ASSETS = {
    "start.js": _Asset("text/javascript"),
    "swagger-ui.css": _Asset("text/css", _bundled() / "swagger-ui.css"),
    "swagger-ui-bundle.js": _Asset("text/javascript", _bundled() / "swagger-ui-bundle.js"),
}


@router.get("/openapi.json")
async def document(request: Request) -> JSONResponse:
    """Return the description of the API for programs."""
    return JSONResponse(request.app.openapi())


@router.get("/docs")
async def page() -> HTMLResponse:
    """Return the page."""
    return HTMLResponse(_PAGE, headers={"Content-Security-Policy": _POLICY})


@router.get("/docs/{name}")
async def asset(name: str) -> Response:
    """Return a script or style of the page."""
    found = _ASSETS.get(name)
    if found is None:
        raise HTTPException(404)
    # One hour, because the names do not depend on the content.
    headers = {"Cache-Control": "public, max-age=3600"}
    if found.file is None:
        return Response(_START, media_type=found.media_type, headers=headers)
    return FileResponse(found.file, media_type=found.media_type, headers=headers)
