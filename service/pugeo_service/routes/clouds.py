# SPDX-License-Identifier: Apache-2.0
"""OpenAPI descriptions of request bodies, and of headers of requests and responses."""

from typing import Any

from pugeo_model.formats import FORMATS
from pugeo_service.http.body import ACCEPTED
from pugeo_service.http.negotiation import OUTPUT_FORMATS
from pugeo_service.models import CANARY_HEADER

__all__ = ["BINARY", "BODY", "CANARY", "HEADERS"]

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
# An extension of OpenAPI, since a media type tells no suffix. The page offers these files. Formats
# that are written come first, in the order of OUTPUT_FORMATS.
_FORMATS = [
    {"name": name, "extensions": list(FORMATS[name].EXTENSIONS), "written": name in OUTPUT_FORMATS}
    for name in dict.fromkeys([*OUTPUT_FORMATS, *FORMATS])
]
BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A point cloud; if the media type is unspecific, the content decides. "
        "x-formats lists all formats that are read.",
        "x-formats": _FORMATS,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}},
                }
            },
            "application/json": {"schema": _POINTS},
            "text/plain": {"schema": {"type": "string"}},
            **{
                kind: BINARY
                for kind in ACCEPTED
                if kind not in {"", "application/json", "text/plain"}
            },
        },
    }
}
CANARY = {
    "name": CANARY_HEADER,
    "in": "header",
    "required": False,
    "description": "yes or no: whether the canary model runs, if there is one; by chance if unset.",
    "schema": {"type": "string", "enum": ["yes", "no"]},
}
HEADERS = {
    name: {"description": text, "schema": {"type": kind}}
    for name, kind, text in (
        ("X-Request-ID", "string", "id of the request, given by the client or random"),
        ("Pugeo-Model", "string", "name of the model"),
        ("Pugeo-Model-Version", "string", "version of the model"),
        ("Pugeo-Model-Sha256", "string", "sha256 of the weights"),
        ("Pugeo-Points-In", "integer", "points read"),
        ("Pugeo-Points-Out", "integer", "points returned"),
        ("Pugeo-Dropped-Non-Finite", "integer", "points dropped because of NaN or infinity"),
        ("Pugeo-Dropped-Duplicate", "integer", "points dropped as duplicates"),
        ("Pugeo-Dropped-Wild", "integer", "points dropped because they are far from all others"),
        ("Pugeo-Notes", "string", "JSON array of sentences about assumptions"),
        ("Preference-Applied", "string", "wait=N if Prefer contains it"),
        ("Server-Timing", "string", "milliseconds by stage"),
    )
}
