# SPDX-License-Identifier: Apache-2.0
"""How OpenAPI describes a cloud that goes in, and one that comes out."""

from typing import Any

__all__ = ["BINARY", "BODY", "HEADERS"]

BINARY = {"schema": {"type": "string", "format": "binary"}}
_POINTS = {
    "type": "object",
    "required": ["points"],
    "properties": {
        "points": {
            "type": "array",
            "items": {
                "type": "array",
                "items": {"type": "number"},
                "minItems": 3,
                "maxItems": 3,
            },
        }
    },
}
BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A point cloud; where the type is unspecific, the content decides.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}},
                }
            },
            "application/json": {"schema": _POINTS},
            "application/x-ply": BINARY,
            "application/x-npz": BINARY,
            "application/x-npy": BINARY,
            "application/octet-stream": BINARY,
            "text/plain": {"schema": {"type": "string"}},
        },
    }
}
HEADERS = {
    name: {"description": text, "schema": {"type": kind}}
    for name, kind, text in (
        ("X-Request-ID", "string", "the request's own id, or a new one"),
        ("Pugeo-Model-Version", "string", "version of the model"),
        ("Pugeo-Model-Sha256", "string", "sha256 of its weights"),
        ("Pugeo-Points-In", "integer", "points read"),
        ("Pugeo-Points-Out", "integer", "points returned"),
        ("Pugeo-Dropped-Non-Finite", "integer", "points dropped for NaN or infinity"),
        ("Pugeo-Dropped-Duplicate", "integer", "points dropped for being there twice"),
        ("Pugeo-Notes", "string", "JSON array of sentences about guesses that were made"),
        ("Preference-Applied", "string", "wait=N where Prefer asked for it"),
        ("Server-Timing", "string", "milliseconds by stage"),
    )
}
