# SPDX-License-Identifier: Apache-2.0
"""Files of our PLY writer, read back by us and by plyfile."""

import io
from collections.abc import Callable

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from pugeo_model import Cloud
from pugeo_model.formats import ply, read, write

Dump = Callable[[Cloud, str], bytes]
Parse = Callable[..., Cloud]


def test_plyfile_reads_ours(rich: Cloud, dump: Dump) -> None:
    """The plyfile package reads every column of our files, with the types that we mean."""
    for name in ("ply", "ply-ascii"):
        vertex = plyfile.PlyData.read(io.BytesIO(dump(rich, name)))["vertex"]
        kinds = {each.name: each.val_dtype for each in vertex.properties}
        assert list(kinds.values()) == ["f4"] * 6 + ["u1"] * 4 + ["f4", "f8", "u1", "i4"]
        assert rich.normals is not None
        assert rich.colors is not None
        columns = [*rich.points.T, *rich.normals.T, *rich.colors.T, *rich.scalars.values()]
        for written, values in zip(kinds, columns, strict=True):
            np.testing.assert_array_equal(vertex[written], values)


def test_binary_header(rich: Cloud, dump: Dump) -> None:
    """The default is binary little endian, uchar red green blue, and the size is known before."""
    data = dump(rich, "ply")
    assert data.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 7\n")
    assert b"property uchar red\nproperty uchar green\nproperty uchar blue\n" in data
    assert data.startswith(ply.header(rich))
    assert ply.size(rich) == len(data)
    assert b"".join([ply.header(rich), *ply.body(rich)]) == data


def test_double_points_stay_double(dump: Dump, parse: Parse) -> None:
    """Doubles are written as doubles, with all digits in text."""
    cloud = Cloud(np.array([[448262.123456789, 1 / 3, -5e-324], [np.pi, 1e300, 0.1]]))
    for name in ("ply", "ply-ascii"):
        back = parse(dump(cloud, name))
        assert back.points.dtype == np.float64
        np.testing.assert_array_equal(back.points, cloud.points)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.array([True, False]), "u1"),
        (np.array([1, 2], np.float16), "f4"),
        (np.array([1, -(2**31)], np.int64), "i4"),
        (np.array([1, 2**32 - 1], np.int64), "u4"),
        (np.array([1, 2**40], np.int64), "f8"),
        (np.array([1, 2], np.uint64), "i4"),
        (np.array([1, 2], ">i2"), "i2"),
    ],
)
def test_types_that_ply_lacks(
    values: np.ndarray[tuple[int], np.dtype[np.generic]], expected: str, dump: Dump, parse: Parse
) -> None:
    """Types outside PLY become the next one that holds the same numbers."""
    back = parse(dump(Cloud(np.zeros((2, 3)), scalars={"v": values}), "ply")).scalars["v"]
    assert back.dtype == np.dtype(expected)
    np.testing.assert_array_equal(back, values.astype(np.float64))


def test_names_cannot_break_the_header(dump: Dump, parse: Parse) -> None:
    """Names with line ends, reserved names, empty and equal names become safe and distinct."""
    names = ["a\nelement face 9", "x", "red", "", "a b", "a_b", "a\tb", "Höhe", "%d", "n" * 999]
    cloud = Cloud(
        np.zeros((1, 3)), scalars={n: np.array([i], np.int32) for i, n in enumerate(names)}
    )
    for name in ("ply", "ply-ascii"):
        back = parse(dump(cloud, name))
        assert [int(each[0]) for each in back.scalars.values()] == list(range(len(names)))
        assert {"scalar_x", "scalar_red", "scalar", "Höhe", "%d"} <= set(back.scalars)


def test_empty_cloud(dump: Dump, parse: Parse) -> None:
    """A cloud of no points is written and read."""
    empty = Cloud(np.empty((0, 3)), scalars={"n": np.empty(0, np.int64)})
    for name in ("ply", "ply-ascii"):
        assert len(parse(dump(empty, name))) == 0


FLOATS = st.sampled_from([np.float32, np.float64])


@st.composite
def clouds(draw: st.DrawFn) -> Cloud:
    count = draw(st.integers(0, 12))
    optional = st.booleans()
    return Cloud(
        points=draw(nps.arrays(draw(FLOATS), (count, 3))),
        normals=draw(nps.arrays(np.float32, (count, 3))) if draw(optional) else None,
        colors=draw(nps.arrays(np.uint8, (count, draw(st.sampled_from([3, 4])))))
        if draw(optional)
        else None,
        scalars={
            f"s_{name}": draw(nps.arrays(draw(st.sampled_from(["f4", "f8", "i4", "u1"])), count))
            for name in draw(st.sets(st.from_regex("[a-z]{1,9}", fullmatch=True), max_size=3))
        },
    )


@pytest.mark.parametrize("name", ["ply", "ply-ascii", "npz"])
@given(cloud=clouds())
def test_round_trip(name: str, cloud: Cloud) -> None:
    """Every cloud comes back bit for bit in value and type, infinities and NaN included."""
    buffer = io.BytesIO()
    write(cloud, buffer, format=name)
    buffer.seek(0)
    back = read(buffer, format=name)
    pairs = [(back.points, cloud.points), (back.normals, cloud.normals)]
    pairs += [(back.colors, cloud.colors)]
    assert list(back.scalars) == list(cloud.scalars)
    pairs += [(back.scalars[key], cloud.scalars[key]) for key in cloud.scalars]
    for ours, theirs in pairs:
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs)
