# SPDX-License-Identifier: Apache-2.0
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pugeo_client
from pugeo_client import _requests
from pugeo_client.errors import ConfigurationError, SourceError
from pugeo_model.formats import WRITABLE


def build(**changes: Any) -> _requests.Request:
    options: dict[str, Any] = {"ratio": None, "format": "ply"}
    return _requests.upsample_request(b"ply\n", **(options | changes))


def test_options_become_query_parameters() -> None:
    """Every option has the name and the form that the service reads."""
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


def test_the_ratio_keeps_its_precision() -> None:
    """A ratio that is no short decimal arrives as the same double."""
    assert float(build(ratio=10 / 3).params["R"]) == 10 / 3


def test_r_is_the_ratio() -> None:
    """`R=` and `ratio=` mean the same; without both the ratio is 4."""
    assert build(R=8).params == build(ratio=8).params
    assert build().params["R"] == "4.0"


def test_n_points_replaces_the_ratio() -> None:
    """An exact count is sent alone; a whole float counts as a whole number."""
    for count in (12345, 12345.0, np.int64(12345)):
        params = build(n_points=count).params
        assert params["n_points"] == "12345"
        assert "R" not in params


def test_a_spacing_replaces_the_ratio() -> None:
    """A spacing is sent without a ratio, and options of the surface by the service's names."""
    params = build(spacing=0.25, density="even", max_gap=2, viewpoint=[(0, 0, 1), (5, 0, 1)]).params
    assert params["spacing"] == "0.25"
    assert "R" not in params
    assert (params["density"], params["max_gap"]) == ("even", "2.0")
    assert params["viewpoint"] == "0.0,0.0,1.0;5.0,0.0,1.0"
    assert build(ratio=1, denoise=True).params["denoise"] == "true"


@pytest.mark.parametrize(
    "both",
    [
        {"ratio": 4, "R": 4},
        {"ratio": 4, "n_points": 9},
        {"R": 4, "n_points": 9},
        {"ratio": 4, "spacing": 0.1},
        {"R": 4, "spacing": 0.1},
        {"n_points": 9, "spacing": 0.1},
    ],
)
def test_one_density_alone(both: dict[str, float]) -> None:
    """Two of ratio, R, n_points and spacing are refused before anything is sent."""
    with pytest.raises(SourceError, match="only one of") as caught:
        build(**both)
    assert all(name in str(caught.value) for name in both)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"viewpoint": (1, 2)}, "x, y, z"),
        ({"viewpoint": 3}, "x, y, z"),
        ({"viewpoint": "abc"}, "x, y, z"),
        ({"ratio": "many"}, "number from 1 to 32"),
        ({"R": [4]}, "number from 1 to 32"),
        ({"n_points": 3.5}, "n_points must be a whole number"),
        ({"n_points": "x"}, "n_points must be a whole number"),
        ({"seed": None}, "seed must be a whole number"),
        ({"spacing": "wide"}, "spacing must be a number"),
        ({"max_gap": [1]}, "max_gap must be a number"),
        ({"seed": float("inf")}, "seed must be a whole number"),
    ],
)
def test_options_of_the_wrong_type(options: dict[str, Any], words: str) -> None:
    """An option that is no number is a SourceError, and no bare ValueError or TypeError."""
    with pytest.raises(SourceError, match=words):
        build(**options)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a.ply", "ply"), ("a.PLY", "ply"), ("a.npz", "npz"), ("a.json", "json"), ("a.LAZ", "laz")],
)
def test_format_by_extension(name: str, expected: str) -> None:
    """The extension of the output file chooses the format of the answer."""
    assert _requests.format_of(Path(name)) == expected


def test_no_format_by_extension() -> None:
    """An unknown extension is refused with the way out; memory holds PLY."""
    with pytest.raises(SourceError, match="format="):
        _requests.format_of(Path("a.obj"))
    assert _requests.format_of(None) == "ply"


def test_address_and_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """An argument precedes the environment, the environment precedes the default."""
    monkeypatch.delenv("PUGEO_URL", raising=False)
    monkeypatch.delenv("PUGEO_API_KEY", raising=False)
    assert _requests.address(None) == "http://127.0.0.1:8000"
    assert "Authorization" not in _requests.base_headers(None)
    assert _requests.base_headers(None)["User-Agent"].startswith(
        f"pugeo-client/{pugeo_client.__version__} (python/3."
    )
    monkeypatch.setenv("PUGEO_URL", "http://far:1")
    monkeypatch.setenv("PUGEO_API_KEY", "k")
    assert _requests.address(None) == "http://far:1"
    assert _requests.address("http://near:2") == "http://near:2"
    assert _requests.base_headers(None)["Authorization"] == "Bearer k"
    assert _requests.base_headers("other")["Authorization"] == "Bearer other"


@pytest.mark.parametrize(
    "key", ["se-cret\n", "se-cret\r\nX: y", "se-cret ü", "se cret", "\0se-cret"]
)
def test_a_key_that_no_header_carries(key: str) -> None:
    """The error tells what is wrong and does not quote the key."""
    with pytest.raises(ConfigurationError, match="line end") as caught:
        _requests.base_headers(key)
    assert "cret" not in str(caught.value)
    assert caught.value.__cause__ is None


@pytest.mark.parametrize(
    ("job_id", "path"),
    [("a/../b", "/jobs/a%2F..%2Fb"), ("a?b#c d", "/jobs/a%3Fb%23c%20d"), ("é", "/jobs/%C3%A9")],
)
def test_ids_are_escaped(job_id: str, path: str) -> None:
    """No id reaches another route, or adds a query."""
    assert _requests.job_request("GET", job_id).path == path
    assert _requests.job_request("GET", job_id, "/result").path == f"{path}/result"


@pytest.mark.parametrize("job_id", ["", ".", ".."])
def test_ids_that_no_url_carries(job_id: str) -> None:
    """An id that would be resolved to another path is refused."""
    with pytest.raises(SourceError, match="no id"):
        _requests.job_request("GET", job_id)


@pytest.mark.parametrize("key", ["", " a", "a\n", "ü", "x" * 256])
def test_idempotency_keys(key: str) -> None:
    """A key that the service would refuse, or that no header carries, is refused here."""
    with pytest.raises(SourceError, match="idempotency_key"):
        _requests.submit_request(build(), key, None)


def test_extensions_are_those_that_the_service_writes() -> None:
    """The SDK knows each extension of each format that is written, and no other."""
    written = {end: name for name, each in WRITABLE.items() for end in each.EXTENSIONS}
    assert written == _requests.EXTENSIONS
