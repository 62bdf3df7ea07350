# SPDX-License-Identifier: Apache-2.0
"""``GET /``: the web page, built from ``viewer/`` into ``static/``, and its assets.

``FastAPI.frontend`` would serve the same files, but lets no headers be set: neither the policy of
the page nor how long its assets may be kept.
"""

from pathlib import Path

from fastapi import APIRouter, HTTPException
from starlette.responses import FileResponse, Response

__all__ = ["STATIC", "router"]

router = APIRouter(include_in_schema=False)

STATIC = Path(__file__).parents[1] / "static"
# Read once: only these names are ever served, whatever a path says.
_ASSETS = {path.name: path for path in (STATIC / "assets").glob("*") if path.is_file()}
_MEDIA_TYPES = {
    ".css": "text/css",
    ".js": "text/javascript",
    ".ply": "application/ply",
    ".svg": "image/svg+xml",
}
_POLICY = "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"


@router.get("/")
async def page() -> Response:
    """Return the page; a browser asks each time whether it has changed."""
    headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-cache"}
    return FileResponse(STATIC / "index.html", media_type="text/html", headers=headers)


@router.get("/assets/{name}")
async def asset(name: str) -> Response:
    """Return a script, style, icon or example of the page."""
    found = _ASSETS.get(name)
    if found is None:
        raise HTTPException(404)
    # Names of scripts and styles carry a hash of their content; those of the others do not.
    hashed = found.suffix in {".css", ".js"}
    age = "max-age=31536000, immutable" if hashed else "max-age=3600"
    # A worker goes by the policy of its own script.
    headers = {"Content-Security-Policy": _POLICY, "Cache-Control": f"public, {age}"}
    return FileResponse(found, media_type=_MEDIA_TYPES[found.suffix], headers=headers)
