# SPDX-License-Identifier: Apache-2.0
import json
import subprocess
import sys
from typing import Any

import pytest

import pugeo_client
from pugeo_client._responses import (
    byte_count,
    check_encoding,
    meta_from_headers,
    parse_object,
    read_cards,
)
from pugeo_client.errors import InvalidResponseError


def test_meta_from_headers() -> None:
    """Every header of a result is read; times are in seconds."""
    meta = meta_from_headers(
        {
            "x-request-id": "abc",
            "pugeo-model-version": "1.0",
            "pugeo-model-sha256": "ff",
            "pugeo-points-in": "1000",
            "pugeo-points-out": "8000",
            "pugeo-dropped-non-finite": "2",
            "pugeo-dropped-duplicate": "3",
            "pugeo-notes": '["units are unknown", "faces \\u2014 left out"]',
            "server-timing": 'read;dur=1.5, infer;desc="net, work; dur=9";dur=250, total',
        }
    )
    assert meta == pugeo_client.Meta(
        model_version="1.0",
        model_sha256="ff",
        request_id="abc",
        points_in=1000,
        points_out=8000,
        dropped={"non_finite": 2, "duplicate": 3},
        timings={"read": 0.0015, "infer": 0.25},
        notes=("units are unknown", "faces — left out"),
    )


@pytest.mark.parametrize(
    "headers",
    [
        {"pugeo-points-out": "many"},
        {"pugeo-points-out": "²"},
        {"pugeo-points-out": "9" * 5000},
        {"pugeo-dropped-": ""},
        {"pugeo-dropped-x": "³"},
        {"server-timing": "x;y, ;dur=1, a;dur=, b;dur=nan, c;dur=-1, d;dur=1e999, e;dur=1.2.3"},
        {"pugeo-notes": ""},
        {"pugeo-notes": "["},
        {"pugeo-notes": '{"a": 1}'},
        {"pugeo-notes": "[" * 90_000},
    ],
)
def test_headers_that_are_missing_or_broken(headers: dict[str, str]) -> None:
    """A header that is not of its form leaves its default, and raises nothing."""
    assert meta_from_headers(headers) == pugeo_client.Meta()


@pytest.mark.parametrize("letter", ["a", "a,", ";dur=1", '"', "a;", " "])
def test_server_timing_takes_linear_time(letter: str) -> None:
    """100,000 letters are parsed at once: a quadratic parser would need minutes or hours."""
    code = (
        "from pugeo_client._responses import meta_from_headers; "
        f"meta_from_headers({{'server-timing': {letter!r} * 100_000}})"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


@pytest.mark.parametrize(
    "body", [b"<html>", b"", b"[1]", b'"x"', b"[" * 100_000, b"\xff", b"9" * 5000]
)
def test_documents_that_are_no_object(body: bytes) -> None:
    """Anything but a JSON object is InvalidResponseError; deep nesting is no RecursionError."""
    with pytest.raises(InvalidResponseError):
        parse_object(body)


@pytest.mark.parametrize("cards", [{}, {"models": 3}, {"models": [1]}])
def test_model_cards_of_another_form(cards: dict[str, Any]) -> None:
    """A list of models that is none is InvalidResponseError, and no KeyError."""
    with pytest.raises(InvalidResponseError, match="models"):
        read_cards(json.loads(json.dumps(cards)))


def test_compressed_answers_are_refused() -> None:
    """No encoding was asked for; identity is none."""
    check_encoding({})
    check_encoding({"content-encoding": "Identity"})
    for encoding in ("gzip", "br", "identity, gzip"):
        with pytest.raises(InvalidResponseError, match="compressed"):
            check_encoding({"content-encoding": encoding})


@pytest.mark.parametrize(("value", "count"), [("12", 12), ("", 0), ("-1", 0), ("²", 0), ("1e3", 0)])
def test_content_length(value: str, count: int) -> None:
    """A length that is no number counts as unknown."""
    assert byte_count({"content-length": value}) == count
    assert byte_count({}) == 0
