# SPDX-License-Identifier: Apache-2.0
import asyncio
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_client._source import CHUNK, Body, Source, make_body
from pugeo_client.errors import SourceError


def read(body: Body) -> bytes:
    return b"".join(body.chunks(lambda _: None))


async def aread(body: Body) -> bytes:
    return b"".join([chunk async for chunk in body.achunks(lambda _: None)])


def unpack(body: Body) -> dict[str, Any]:
    return dict(np.load(io.BytesIO(read(body)), allow_pickle=False))


@pytest.fixture
def big(tmp_path: Path) -> Path:
    path = tmp_path / "scan.ply"
    path.write_bytes(os.urandom(3 * CHUNK + 17))
    return path


def test_a_path_is_streamed_again_for_a_retry(big: Path) -> None:
    """A file is sent unchanged, in chunks, and again for a retry."""
    body = make_body(big)
    assert body.media_type == "application/x-ply"
    assert body.length == big.stat().st_size
    sizes: list[int] = []
    assert b"".join(body.chunks(lambda chunk: sizes.append(len(chunk)))) == big.read_bytes()
    assert max(sizes) <= CHUNK
    assert body.sendable
    assert read(body) == asyncio.run(aread(body)) == big.read_bytes()


@pytest.mark.parametrize("wrap", [bytes, bytearray, memoryview, io.BytesIO])
def test_bytes_in_every_wrapping(wrap: Any) -> None:
    """Bytes of a file are sent unchanged from every kind of buffer."""
    body = make_body(wrap(b"ply\n..."))
    assert (read(body), read(body), body.length) == (b"ply\n...", b"ply\n...", 7)


def test_an_open_file_is_sent_from_its_position(big: Path) -> None:
    """A retry starts at the first position of the file, which stays open."""
    with big.open("rb") as file:
        file.seek(100)
        body = make_body(file)
        assert body.length == big.stat().st_size - 100
        assert read(body) == read(body) == big.read_bytes()[100:]
        assert not file.closed


def test_a_pipe_is_sent_once() -> None:
    """A pipe is not sendable again once it was read."""
    reader, writer = os.pipe()
    os.write(writer, b"ply\n")
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        body = make_body(file)
        assert body.length is None
        assert body.sendable
        assert read(body) == b"ply\n"
        assert not body.sendable


def test_arrays_are_packed_as_npz() -> None:
    """An (N, 3) array keeps its precision; columns 4 to 6 of an (N, 6) array are normals."""
    points = np.array([[500000.125, 2, 3], [4, 5, 6]], dtype=np.float64)
    only = unpack(make_body(points))
    assert list(only) == ["points"]
    assert only["points"].dtype == np.float64
    np.testing.assert_array_equal(only["points"], points)
    both = unpack(make_body(np.hstack([points, points]).astype(np.float32)))
    assert both["points"].dtype == np.float32
    np.testing.assert_array_equal(both["normals"], points.astype(np.float32))


def test_integer_points_become_doubles() -> None:
    """Integer points are sent as doubles."""
    assert unpack(make_body(np.arange(6).reshape(2, 3)))["points"].dtype == np.float64


def test_a_dict_of_arrays() -> None:
    """Normals, colours and scalars are sent with the points; None is left out."""
    given = {
        "points": [[0.0, 0, 0], [1, 1, 1]],
        "normals": None,
        "colors": np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8),
        "scalars": {"intensity": np.array([0.5, 1.5], dtype=np.float32)},
    }
    packed = unpack(make_body(given))
    assert set(packed) == {"points", "colors", "intensity"}
    assert packed["intensity"].dtype == np.float32


@pytest.mark.parametrize(
    "source",
    [
        None,
        42,
        io.StringIO("1 2 3"),
        np.zeros((4, 2)),
        np.zeros((2, 4, 3)),
        np.array([["a", "b", "c"]]),
        {"normals": np.zeros((4, 3))},
        {"points": np.zeros((4, 3)), "colours": np.zeros((4, 3))},
        {"points": np.zeros((4, 3)), "normals": np.zeros((3, 3))},
        {"points": np.zeros((4, 3)), "scalars": {"name": np.array(["a"] * 4, dtype=object)}},
        {"points": np.zeros((4, 3)), "scalars": {"points": np.zeros(4)}},
    ],
)
def test_sources_that_cannot_be_sent(source: Source) -> None:
    """Each is a SourceError, which is a ValueError too."""
    with pytest.raises(SourceError) as caught:
        make_body(source)
    assert isinstance(caught.value, ValueError)


def test_a_missing_file(tmp_path: Path) -> None:
    """A path that does not exist raises FileNotFoundError, as `open` does."""
    with pytest.raises(FileNotFoundError):
        make_body(tmp_path / "nowhere.ply")
