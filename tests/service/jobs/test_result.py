# SPDX-License-Identifier: Apache-2.0
"""The result over HTTP, with conditional and range requests."""

import base64
import hashlib
from typing import Any

BODY = b"dense cloudcloud"
ETAG = f'"{hashlib.sha256(BODY).hexdigest()}"'


CASES: list[tuple[dict[str, str], int, bytes]] = [
    ({}, 200, BODY),
    ({"Range": "bytes=6-10"}, 206, b"cloud"),
    ({"Range": "bytes=11-"}, 206, b"cloud"),
    ({"Range": "bytes=-5"}, 206, b"cloud"),
    ({"Range": "bytes=0-999"}, 206, BODY),
    ({"Range": "lines=1-2"}, 200, BODY),
    ({"Range": "bytes=what"}, 200, BODY),
    ({"Range": "bytes=6-10", "If-Range": ETAG}, 206, b"cloud"),
    ({"Range": "bytes=6-10", "If-Range": '"old"'}, 200, BODY),
    ({"If-None-Match": ETAG}, 304, b""),
    ({"If-None-Match": f'"old", W/{ETAG}'}, 304, b""),
    ({"If-None-Match": "*"}, 304, b""),
    ({"If-None-Match": '"old"'}, 200, BODY),
    ({"If-None-Match": ETAG, "Range": "bytes=0-1"}, 304, b""),
]


def test_conditions_and_ranges(play: Any) -> None:
    """Each combination of headers gets status and bytes as in RFC 9110."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        for headers, status, body in CASES:
            answer = await house.http.get(f"/jobs/{job['id']}/result", headers=headers)
            assert (answer.status_code, answer.content) == (status, body), headers
            assert answer.headers["etag"] == ETAG
            told = answer.headers.get("content-range", "bytes 0-15/16")
            first, last = told.removeprefix("bytes ").removesuffix("/16").split("-")
            assert BODY[int(first) : int(last) + 1] == (body or BODY), headers
            assert ("content-range" in answer.headers) == (status == 206), headers

    play(scenario)


def test_what_headers_say(play: Any) -> None:
    """Length, digest, expiry, file name and the headers of /upsample, also for HEAD."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        done = await house.until(job["id"], "succeeded")
        path = f"/jobs/{job['id']}/result"
        answer, head = await house.http.get(path), await house.http.head(path)
        assert (head.status_code, head.content) == (200, b"")
        for found in (answer, head):
            headers = found.headers
            assert headers["content-length"] == str(len(BODY)) == str(done["result"]["bytes"])
            assert headers["accept-ranges"] == "bytes"
            assert headers["content-type"] == done["result"]["media_type"] == "application/ply"
            assert headers["content-disposition"] == 'attachment; filename="upsampled.ply"'
            assert headers["pugeo-points-out"] == "8"
            assert headers["pugeo-dropped-duplicate"] == "2"
            assert "predict;dur=500.0" in headers["server-timing"]
            assert "private" in headers["cache-control"]
            assert "GMT" in headers["expires"]
            digest = base64.b64encode(hashlib.sha256(BODY).digest()).decode()
            assert headers["repr-digest"] == f"sha-256=:{digest}:"

    play(scenario)


def test_a_range_outside(play: Any) -> None:
    """A range after the end is a 416 problem with the size."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        headers = {"Range": "bytes=16-"}
        answer = await house.http.get(f"/jobs/{job['id']}/result", headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (416, "bad_range")
        assert answer.headers["content-range"] == "bytes */16"
        assert answer.headers["content-type"] == "application/problem+json"

    play(scenario)


def test_a_file_that_somebody_removed(play: Any) -> None:
    """A missing file is a 410."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        (house.folder / "results" / job["id"]).unlink()
        answer = await house.http.get(f"/jobs/{job['id']}/result")
        assert (answer.status_code, answer.json()["code"]) == (410, "result_gone")

    play(scenario)
