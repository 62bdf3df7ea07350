# SPDX-License-Identifier: Apache-2.0
"""The check of received clouds, against files that the model package writes."""

import io
import zipfile
from typing import Any

import numpy as np
import pytest

from pugeo_client._verify import verify_cloud
from pugeo_client.errors import InvalidResponseError
from pugeo_model import formats
from pugeo_model.cloud import Cloud

FORMATS = ["ply", "ply-ascii", "npz", "npy", "json", "xyz"]
POINTS = 40_000  # several chunks in every format


def written(format: str, count: int, **attributes: Any) -> bytes:
    """A cloud as the service writes it."""
    points = np.random.default_rng(0).random((count, 3))
    file = io.BytesIO()
    formats.write(Cloud(points=points, **attributes), file, format=format)
    return file.getvalue()


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("count", [0, 1, 2, POINTS])
def test_complete_clouds_pass(format: str, count: int) -> None:
    """A whole file of the stated number of points passes, with and without attributes."""
    if format != "npy":
        label = {"höhe, [m]": np.arange(count, dtype=np.int32)}
        colors = np.full((count, 3), 7, dtype=np.uint8)
        verify_cloud(
            io.BytesIO(written(format, count, colors=colors, scalars=label)), format, count
        )
    verify_cloud(io.BytesIO(written(format, count)), format, count)
    verify_cloud(io.BytesIO(written(format, count)), format, None)


@pytest.mark.parametrize("format", FORMATS)
def test_another_number_of_points(format: str) -> None:
    """Fewer or more points than the headers state are refused."""
    data = written(format, POINTS)
    for stated in (POINTS - 1, POINTS + 1, 0):
        with pytest.raises(InvalidResponseError, match=f"{POINTS} points"):
            verify_cloud(io.BytesIO(data), format, stated)


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(
    "body",
    [
        b"<!DOCTYPE html><html><body>Please log in</body></html>",
        b"\n  <html>" + b"x" * 100_000,
        b"",
        b"Service unavailable\n",
        b'{"error": "no"}',
        b"PK\x03\x04",
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff{",
        b"ply\n",
    ],
)
def test_something_else(format: str, body: bytes) -> None:
    """A web page, or any other text, is no cloud of any format."""
    with pytest.raises(InvalidResponseError):
        verify_cloud(io.BytesIO(body), format, 1000)


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.999])
def test_files_that_are_cut(format: str, kept: float) -> None:
    """A cut file is found by the number of its points."""
    data = written(format, POINTS, scalars={} if format == "npy" else {"a": np.arange(POINTS)})
    with pytest.raises(InvalidResponseError):
        verify_cloud(io.BytesIO(data[: int(len(data) * kept)]), format, POINTS)


def test_a_web_page_in_a_format_of_the_future() -> None:
    """For a format that this client does not know, a web page is refused all the same."""
    verify_cloud(io.BytesIO(b"LASF"), "las", 7)
    with pytest.raises(InvalidResponseError, match="web page"):
        verify_cloud(io.BytesIO(b"<html>"), "las", 7)


def packed(arrays: dict[str, Any], method: int = zipfile.ZIP_STORED) -> io.BytesIO:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in arrays.items():
            member = io.BytesIO()
            np.save(member, data)
            archive.writestr(f"{name}.npy", member.getvalue())
    return file


def test_archives_that_are_no_cloud() -> None:
    """Compressed members, missing points and arrays of other lengths are refused."""
    points = np.zeros((5, 3))
    verify_cloud(packed({"points": points}), "npz", 5)
    for wrong in (
        packed({"points": points}, zipfile.ZIP_DEFLATED),
        packed({"normals": points}),
        packed({"points": points[:, :2]}),
        packed({"points": points, "label": np.zeros(4)}),
        packed({"points": np.array(5.0)}),
    ):
        with pytest.raises(InvalidResponseError):
            verify_cloud(wrong, "npz", 5)
