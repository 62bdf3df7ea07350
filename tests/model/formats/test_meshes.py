# SPDX-License-Identifier: Apache-2.0
"""OBJ and STL: corners as points, with a note."""

import io
import struct
from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError
from pugeo_model.formats import read

Parse = Callable[..., Cloud]
OBJ = "# made\nmtllib a.mtl\no one\nv 1 2 3 0.5 0 1\nv 4 5 6 1 0.2 0 # second\nvt 0 1\n"


def stl(points: list[list[float]]) -> bytes:
    """Binary STL of triangles whose corners are these, three each."""
    rows = np.zeros(len(points) // 3, [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    rows["c"] = np.array(points, np.float32).reshape(-1, 3, 3)
    return b"made".ljust(80) + struct.pack("<I", len(rows)) + rows.tobytes()


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_obj(parse: Parse, end: str) -> None:
    """Vertices, their colours and as many normals are read; faces are dropped with a note."""
    text = OBJ + "vn 0 0 1\nvn 0 1 0\nf 1/1/1 2//2 1\nf 1 2 1\n"
    cloud = parse(text.replace("\n", end).encode())
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[128, 0, 255], [255, 51, 0]]
    assert cloud.normals is not None
    assert cloud.normals.tolist() == [[0, 0, 1], [0, 1, 0]]
    assert "its 2 faces are dropped" in cloud.notes[0]


def test_obj_with_other_normals(parse: Parse) -> None:
    """Normals that do not belong to vertices one by one are dropped with a note."""
    cloud = parse((OBJ + "vn 0 0 1\n").encode())
    assert cloud.normals is None
    assert "there are 1 for 2 vertices" in cloud.notes[0]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("o a\n", "no vertices"),
        ("v 1 2 3\nv 1 2\n", "2, 3 numbers"),
        ("v 1 2\n", "have 2 numbers"),
        ("v 1 2 x\n", "no number"),
    ],
)
def test_broken_obj(text: str, match: str) -> None:
    """A vertex that makes no sense is refused."""
    with pytest.raises(MalformedFileError, match=match):
        read(io.BytesIO(text.encode()), format="obj")


def test_stl(parse: Parse) -> None:
    """Corners of text and binary files become points, each once, in their order."""
    corners: list[list[float]] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    loops = "".join(
        "facet normal 0 0 1\n outer loop\n"
        + "".join(f"  vertex {x:g} {y:g} {z:e}\n" for x, y, z in corners[i : i + 3])
        + " endloop\nendfacet\n"
        for i in (0, 3)
    )
    text = parse(f"solid made by a test\n{loops}endsolid\n".encode())
    binary = read(io.BytesIO(stl(corners)), format="stl")
    for cloud in (text, binary):
        assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
        assert "its 2 triangles are dropped, and their 4 corners" in cloud.notes[0]
    assert binary.points.dtype == np.float32


def test_broken_stl() -> None:
    """Truncated and lying files are refused, and corners bounded."""
    data = stl([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(MalformedFileError, match="ends too early"):
        read(io.BytesIO(data[:-1]), format="stl")
    with pytest.raises(MalformedFileError, match="shorter than the header"):
        read(io.BytesIO(data[:50]), format="stl")
    with pytest.raises(LimitExceededError):
        read(io.BytesIO(data[:80] + b"\xff" * 4 + data[84:]), format="stl")
    with pytest.raises(MalformedFileError, match="no whole triangles"):
        read(io.BytesIO(b"solid a\nfacet normal 0 0 1\nvertex 1 2 3\n"), format="stl")
    with pytest.raises(MalformedFileError, match="no number"):
        read(io.BytesIO(b"solid a\nfacet\n" + b"vertex 1 2 x\n" * 3), format="stl")


def test_obj_limit(parse: Parse) -> None:
    """Vertices are bounded as they are met."""
    with pytest.raises(LimitExceededError):
        parse(b"v 1 2 3\n" * 11, max_points=10)
    assert len(parse(b"v 1 2 3\n" * 10, max_points=10)) == 10
