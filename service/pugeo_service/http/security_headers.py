# SPDX-License-Identifier: Apache-2.0
"""Headers for browsers: security headers of each response, and the CORS configuration."""

from typing import Any

from starlette.datastructures import MutableHeaders

__all__ = ["CORS", "add_security_headers"]

_NO_PAGE = "default-src 'none'; frame-ancestors 'none'"

# Requests and response headers that pages of other origins may use if PUGEO_CORS_ORIGINS lists
# them. The service sets no cookies, so credentials stay off.
CORS: dict[str, Any] = {
    "allow_methods": ["GET", "HEAD", "POST", "DELETE"],
    "allow_headers": [
        "Authorization", "Content-Type", "Idempotency-Key", "If-None-Match", "Last-Event-ID",
        "Prefer", "Pugeo-Canary", "Range", "X-API-Key", "X-Request-ID",
    ],
    "expose_headers": [
        "Accept-Ranges", "Content-Disposition", "Content-Range", "ETag", "Location",
        "Preference-Applied", "Pugeo-Dropped-Duplicate", "Pugeo-Dropped-Non-Finite",
        "Pugeo-Dropped-Wild", "Pugeo-Model", "Pugeo-Model-Sha256", "Pugeo-Model-Version",
        "Pugeo-Notes", "Pugeo-Points-In", "Pugeo-Points-Out", "Retry-After", "Server-Timing",
        "X-Request-ID",
    ],
    "max_age": 3600,
}  # fmt: skip


def add_security_headers(headers: MutableHeaders) -> None:
    """Forbid browsers to guess types, embed the response in frames, cache it or send a referrer.

    A route may set its own ``Content-Security-Policy`` or ``Cache-Control``, such as a page with
    scripts or a result that may be cached; these are kept.
    """
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Referrer-Policy"] = "no-referrer"
    headers.setdefault("Content-Security-Policy", _NO_PAGE)
    headers.setdefault("Cache-Control", "no-store")
