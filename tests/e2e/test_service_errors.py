# SPDX-License-Identifier: Apache-2.0
"""Bad input is answered with a problem, and the service goes on."""

import io
from typing import Any, Protocol

import httpx2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.http_client import HTTP

from pugeo_model import Cloud, formats

GOOD = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str


def ply(points: NDArray[Any]) -> bytes:
    """Points as a binary PLY file."""
    buffer = io.BytesIO()
    formats.write(Cloud(points.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


def header(*lines: str) -> bytes:
    """The header of a PLY file."""
    return "\n".join(["ply", *lines, "end_header", ""]).encode()


LITTLE = "format binary_little_endian 1.0"
XYZ = ("property float x", "property float y", "property float z")
LINE = np.linspace(0, 1, 100)[:, None] * np.array([[1.0, 2.0, 3.0]])

# name: body, headers, query, status
CASES: dict[str, tuple[bytes, dict[str, str], str, int]] = {
    "an empty body": (b"", {}, "", 400),
    "a truncated PLY": (ply(GOOD)[:-10], {}, "", 400),
    "a PLY of four thousand million points": (
        header(LITTLE, "element vertex 4000000000", *XYZ) + bytes(1200),
        {},
        "",
        413,
    ),
    "a PLY header without an end": (b"ply\n" + b"comment " + b"x" * (20 << 20), {}, "", 413),
    "a PLY without vertices": (header(LITTLE, "element vertex 0", *XYZ), {}, "", 422),
    "a PLY of another version": (header("format binary 9", "element vertex 1", *XYZ), {}, "", 400),
    "only NaN": (ply(np.full((50, 3), np.nan)), {}, "", 422),
    "three points": (ply(GOOD[:3]), {}, "", 422),
    "a thousand times the same point": (ply(np.ones((1000, 3))), {}, "", 422),
    "all points on a line": (ply(LINE), {}, "", 422),
    "R=0": (ply(GOOD), {}, "?R=0", 422),
    "R=1e9": (ply(GOOD), {}, "?R=1e9", 422),
    "R=abc": (ply(GOOD), {}, "?R=abc", 422),
    "R=nan": (ply(GOOD), {}, "?R=nan", 422),
    "an unknown option": (ply(GOOD), {}, "?ratio=4", 422),
    "an unknown orientation": (ply(GOOD), {}, "?orient=sideways", 422),
    "a viewpoint that is missing": (ply(GOOD), {}, "?orient=viewpoint", 422),
    "too many points out for the input": (ply(GOOD), {}, "?n_points=100000", 422),
    "an unknown format of the answer": (ply(GOOD), {}, "?format=docx", 422),
    "an output format that does not exist": (ply(GOOD), {"Accept": "image/png"}, "", 406),
    "another content type": (ply(GOOD), {"Content-Type": "image/png"}, "", 415),
    "a compressed body": (ply(GOOD), {"Content-Encoding": "gzip"}, "", 415),
    "bytes of no known kind": (bytes(range(256)) * 20, {}, "", 415),
    "JSON that is none": (b'{"points": [[0,0', {"Content-Type": "application/json"}, "", 400),
    "JSON of strings": (
        b'{"points": [["a","b","c"]]}',
        {"Content-Type": "application/json"},
        "",
        400,
    ),
    "JSON of pairs": (b'{"points": [[1,2],[3,4]]}', {"Content-Type": "application/json"}, "", 400),
    "an NPY of objects": (
        b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (9, 3), }".ljust(
            127
        )
        + b"\n",
        {},
        "",
        400,
    ),
    "a zip that is none": (b"PK\x03\x04" + bytes(100), {}, "", 400),
    "a form without a file": (
        b"--B--\r\n",
        {"Content-Type": "multipart/form-data; boundary=B"},
        "",
        400,
    ),
    "a body too large": (bytes(33 << 20), {}, "", 413),
    "more points than allowed": (
        ply(np.random.default_rng(0).normal(size=(300_001, 3))),
        {},
        "",
        413,
    ),
}


def check_problem(response: httpx2.Response, status: int) -> dict[str, Any]:
    """Check all members of a problem document."""
    assert response.status_code == status, response.text[:500]
    assert response.headers["content-type"] == "application/problem+json"
    found: dict[str, Any] = response.json()
    assert found["status"] == status
    assert found["type"] == f"urn:pugeo:problem:{found['code']}"
    assert found["title"]
    assert len(found["detail"]) > 10
    assert found["request_id"] == response.headers["x-request-id"]
    assert found["retryable"] is (status in {408, 503, 504})
    return found


@pytest.mark.parametrize("name", list(CASES))
def test_bad_input(server: Server, name: str) -> None:
    """Bad input gets a problem, and the next good request is served."""
    body, headers, query, status = CASES[name]
    url = f"{server.url}/upsample"
    response = HTTP.post(url + query, content=body, headers=headers, timeout=30)
    check_problem(response, status)
    good = HTTP.post(f"{url}?R=2", content=ply(GOOD), timeout=60)
    assert good.status_code == 200, good.text


def test_faults_of_the_input_are_no_tracebacks(server: Any) -> None:
    """The log has a line for a refused cloud, and neither a traceback nor its arguments."""
    before = len(server.log.read_text())
    refused = HTTP.post(f"{server.url}/upsample", content=ply(LINE), timeout=60)
    assert refused.status_code == 422
    # The worker writes its own lines; a second answer means that those of the first are there.
    assert HTTP.post(f"{server.url}/upsample", content=ply(GOOD), timeout=60).status_code == 200
    told = server.log.read_text()[before:]
    assert refused.headers["x-request-id"] in told
    assert "Traceback" not in told
    assert "Compute Failed" not in told


def test_some_bad_points_are_dropped(server: Server) -> None:
    """NaN rows are dropped and counted."""
    points = np.concatenate([GOOD, np.full((3, 3), np.nan, dtype=np.float32)])
    response = HTTP.post(f"{server.url}/upsample?R=2", content=ply(points), timeout=60)
    assert response.status_code == 200, response.text
    assert response.headers["pugeo-dropped-non-finite"] == "3"
    assert response.headers["pugeo-points-out"] == "80"


def test_limits_are_named(server: Server) -> None:
    """413 contains the limit and the value."""
    found = HTTP.post(f"{server.url}/upsample", content=bytes(33 << 20), timeout=30).json()
    assert (found["code"], found["limit"]) == ("body_too_large", 32 << 20)
    assert found["value"] >= 32 << 20


def test_too_large_without_saying_so(server: Server) -> None:
    """A chunked body without an end is refused at the limit."""
    sent = 0

    def pieces() -> Any:
        nonlocal sent
        while sent < 200 << 20:
            sent += 1 << 20
            yield bytes(1 << 20)

    try:
        response = HTTP.post(f"{server.url}/upsample", content=pieces(), timeout=60)
    except httpx2.TransportError:
        # The service may close the connection before the client reads the answer.
        pass
    else:
        check_problem(response, 413)
    assert HTTP.get(f"{server.url}/health/live", timeout=60).status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("GET", "/upsample/", 404),
        ("GET", "/upsample", 405),
        ("DELETE", "/models", 405),
        ("GET", "/models/other", 404),
    ],
)
def test_routes(server: Server, method: str, path: str, status: int) -> None:
    """Wrong paths and methods are problems too."""
    check_problem(HTTP.request(method, server.url + path, timeout=60), status)


def test_unknown_options_are_named(server: Server) -> None:
    """The error for an unknown option lists all options."""
    response = HTTP.post(f"{server.url}/upsample?ratio=4", content=ply(GOOD), timeout=60)
    found = check_problem(response, 422)
    assert found["parameter"] == "ratio"
    assert "n_points" in found["allowed"]
