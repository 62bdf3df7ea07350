# SPDX-License-Identifier: Apache-2.0
"""Parsing of answers: headers and JSON documents. Linear in their length."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from pugeo_client._result import Meta
from pugeo_client.errors import InvalidResponseError

__all__ = [
    "MAX_ERROR_BYTES",
    "byte_count",
    "check_encoding",
    "meta_from_headers",
    "parse_object",
    "read_cards",
]

MAX_ERROR_BYTES = 1 << 20
"""Of the body of an error answer; the rest is not read."""
_DROPPED = "pugeo-dropped-"
_COUNT = re.compile(r"[0-9]{1,18}")
_QUOTED = re.compile(r'"[^"]*"')


def parse_object(body: bytes) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        InvalidResponseError: it is no JSON, or JSON of another type.
    """
    try:
        value = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InvalidResponseError(f"the answer is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise InvalidResponseError(f"the answer is no JSON object but {type(value).__name__}")
    return value


def read_cards(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the model cards of an answer.

    Raises:
        InvalidResponseError: there are none.
    """
    cards = answer.get("models")
    if not isinstance(cards, list) or not all(isinstance(card, dict) for card in cards):
        raise InvalidResponseError("the answer has no list of models")
    return cards


def check_encoding(headers: Mapping[str, str]) -> None:
    """Refuse a compressed answer: none was asked for, and a small one may unpack to gigabytes.

    Raises:
        InvalidResponseError: the answer has a Content-Encoding.
    """
    encoding = headers.get("content-encoding", "identity").strip().lower()
    if encoding not in {"", "identity"}:
        raise InvalidResponseError(
            f"the answer is compressed ({encoding[:40]}) although the request did not allow it; "
            "a proxy may have done that"
        )


def byte_count(headers: Mapping[str, str]) -> int:
    """Read Content-Length; 0 where it is missing or no number."""
    return _count(headers.get("content-length")) or 0


def meta_from_headers(headers: Mapping[str, str]) -> Meta:
    """Read the description of a result from its headers.

    A header that is missing, or not of its form, leaves its default.

    Args:
        headers: by lower-case name.
    """
    dropped = {
        name.removeprefix(_DROPPED).replace("-", "_"): count
        for name, value in headers.items()
        if name.startswith(_DROPPED) and (count := _count(value)) is not None
    }
    return Meta(
        model=headers.get("pugeo-model", ""),
        model_version=headers.get("pugeo-model-version", ""),
        model_sha256=headers.get("pugeo-model-sha256", ""),
        request_id=headers.get("x-request-id", ""),
        points_in=_count(headers.get("pugeo-points-in")),
        points_out=_count(headers.get("pugeo-points-out")),
        dropped=dropped,
        timings=_timings(headers.get("server-timing", "")),
        notes=_notes(headers.get("pugeo-notes", "[]")),
    )


def _count(value: str | None) -> int | None:
    return int(value) if value is not None and _COUNT.fullmatch(value) else None


def _timings(server_timing: str) -> dict[str, float]:
    """Parse ``infer;dur=12.5, merge;dur=3`` into seconds by stage."""
    timings = {}
    # Descriptions are quoted and may have commas.
    for metric in _QUOTED.sub("", server_timing).split(","):
        stage, *parameters = (part.strip() for part in metric.split(";"))
        for parameter in parameters:
            name, _, value = parameter.partition("=")
            milliseconds = _number(value) if name.strip().lower() == "dur" else None
            if stage and milliseconds is not None:
                timings[stage] = milliseconds / 1000
    return timings


def _number(value: str) -> float | None:
    """Parse a finite number that is not negative."""
    try:
        number = float(value)
    except ValueError:
        return None
    return number if 0 <= number < math.inf else None


def _notes(value: str) -> tuple[str, ...]:
    try:
        notes = json.loads(value)
    except (ValueError, RecursionError):
        return ()
    return tuple(str(note) for note in notes) if isinstance(notes, list) else ()
