# SPDX-License-Identifier: Apache-2.0
from pathlib import Path
from typing import Any

import pytest

import pugeo_client
from pugeo_client import _wire
from pugeo_client.errors import InvalidResponseError, SourceError


def build(**changes: Any) -> _wire.Request:
    options: dict[str, Any] = {"ratio": 8, "answer": "ply"}
    return _wire.upsample_request(b"ply\n", **(options | changes))


def test_options_are_the_service_s_words() -> None:
    """Every option goes where the service looks for it."""
    request = build(
        ratio=2.5, seed=7, orient="viewpoint", viewpoint=(500000.125, -1, 0), keep_input=True
    )
    assert (request.method, request.path) == ("POST", "/upsample")
    assert dict(request.params) == {
        "R": "2.5",
        "seed": "7",
        "orient": "viewpoint",
        "viewpoint": "500000.125,-1.0,0.0",
        "keep_input": "true",
        "format": "ply",
    }
    assert request.headers["Content-Length"] == "4"


def test_a_ratio_keeps_its_digits() -> None:
    """A ratio that is no round number arrives as the same double."""
    assert float(build(ratio=10 / 3).params["R"]) == 10 / 3


def test_n_points_takes_the_place_of_the_ratio() -> None:
    """The service is never sent both."""
    params = build(n_points=12345).params
    assert params["n_points"] == "12345"
    assert "R" not in params


def test_a_viewpoint_has_three_numbers() -> None:
    """A viewpoint of two numbers is refused here."""
    with pytest.raises(SourceError, match="x, y, z"):
        build(viewpoint=(1, 2))


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a.ply", "ply"), ("a.PLY", "ply"), ("a.npz", "npz"), ("a.json", "json"), ("a.xyz", "xyz")],
)
def test_format_by_extension(name: str, expected: str) -> None:
    """The file's extension chooses the answer's format."""
    assert _wire.default_format(Path(name)) == expected


def test_no_format_by_extension() -> None:
    """An extension without a format asks for one, and memory holds PLY."""
    with pytest.raises(SourceError, match="format="):
        _wire.default_format(Path("a.laz"))
    assert _wire.default_format(None) == "ply"


def test_addresses_and_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """An argument goes before the environment, the environment before the default."""
    monkeypatch.delenv("PUGEO_URL", raising=False)
    monkeypatch.delenv("PUGEO_API_KEY", raising=False)
    assert _wire.base_url(None) == "http://127.0.0.1:8000"
    assert "Authorization" not in _wire.base_headers(None)
    assert _wire.base_headers(None)["User-Agent"].startswith(
        f"pugeo-client/{pugeo_client.__version__} (python/3."
    )
    monkeypatch.setenv("PUGEO_URL", "http://far:1/")
    monkeypatch.setenv("PUGEO_API_KEY", "k")
    assert _wire.base_url(None) == "http://far:1"
    assert _wire.base_url("http://near:2/") == "http://near:2"
    assert _wire.base_headers(None)["Authorization"] == "Bearer k"
    assert _wire.base_headers("other")["Authorization"] == "Bearer other"


def test_meta_from_headers() -> None:
    """Every header of a result finds its place; times are seconds."""
    meta = _wire.meta_of(
        {
            "x-request-id": "abc",
            "pugeo-model-version": "1.0",
            "pugeo-model-sha256": "ff",
            "pugeo-points-in": "1000",
            "pugeo-points-out": "8000",
            "pugeo-dropped-non-finite": "2",
            "pugeo-dropped-duplicate": "3",
            "pugeo-notes": '["units are unknown", "faces \\u2014 left out"]',
            "server-timing": 'read;dur=1.5, infer;desc="network";dur=250, total',
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


def test_meta_without_headers() -> None:
    """A service behind a proxy that strips headers still gives a result."""
    headers = {"pugeo-points-out": "many", "pugeo-dropped-": "", "server-timing": "x;y"}
    for notes in ("", "[", '{"a": 1}'):
        assert _wire.meta_of(headers | {"pugeo-notes": notes}) == pugeo_client.Meta()


def test_no_json() -> None:
    """A page where JSON was due is an error of ours."""
    with pytest.raises(InvalidResponseError):
        _wire.read_json(b"<html>")
