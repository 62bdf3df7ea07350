# SPDX-License-Identifier: Apache-2.0
import io
import os
from pathlib import Path

import numpy as np
import pytest

from pugeo_client import Meta, PugeoError, Result
from pugeo_client.errors import InvalidResponseError, SourceError


@pytest.fixture(params=["memory", "disk"])
def result(request: pytest.FixtureRequest, ply_bytes: bytes, tmp_path: Path) -> Result:
    """The same answer in memory and on disk."""
    if request.param == "memory":
        return Result(Meta(points_out=3), format="ply", data=ply_bytes)
    path = tmp_path / "answer.ply"
    path.write_bytes(ply_bytes)
    return Result(Meta(points_out=3), format="ply", path=path)


def test_arrays(result: Result) -> None:
    """Points keep double precision, and every attribute has its shape and type."""
    assert result.points.dtype == np.float64
    np.testing.assert_array_equal(result.points[0], [500000.125, 4, 7])
    assert result.normals is not None
    assert result.normals.shape == (3, 3)
    assert result.normals.dtype == np.dtype(np.float32)
    assert result.colors is not None
    assert result.colors.shape == (3, 3)
    assert result.colors.dtype == np.dtype(np.uint8)
    assert result.colors[:, 0].tolist() == [1, 2, 255]
    assert {name: values.dtype.str for name, values in result.scalars.items()} == {
        "intensity": "<f4",
        "label": "<i4",
    }
    assert len(result) == 3
    assert "3 points" in repr(result)


def test_save_ply_copies_the_answer(result: Result, ply_bytes: bytes, tmp_path: Path) -> None:
    """A PLY is saved byte for byte, also over an older file or over itself."""
    target = tmp_path / "dense.PLY"
    target.write_bytes(b"older")
    assert result.save(target) == target
    assert target.read_bytes() == ply_bytes
    if result.path:
        result.save(result.path)
        assert result.path.read_bytes() == ply_bytes


def test_save_npz_and_read_back(result: Result, tmp_path: Path) -> None:
    """NPZ has every array by name, and is read back as the same result."""
    data = result.save(tmp_path / "dense.npz").read_bytes()
    again = Result(Meta(), format="npz", data=data)
    np.testing.assert_array_equal(again.points, result.points)
    np.testing.assert_array_equal(again.normals, result.normals)
    np.testing.assert_array_equal(again.colors, result.colors)
    assert again.scalars["label"].tolist() == [7, 8, 9]


def test_save_npy_and_read_back(result: Result, tmp_path: Path) -> None:
    """NPY has points and normals in the layout that `upsample` accepts."""
    data = result.save(tmp_path / "dense.npy").read_bytes()
    assert np.load(io.BytesIO(data)).shape == (3, 6)
    again = Result(Meta(), format="npy", data=data)
    np.testing.assert_array_equal(again.points, result.points)
    np.testing.assert_array_equal(again.normals, result.normals)
    assert again.colors is None


def test_save_xyz_is_exact(result: Result, tmp_path: Path) -> None:
    """The same doubles are read back from the text, and colours are whole numbers."""
    text = result.save(str(tmp_path / "dense.xyz"))
    rows = np.loadtxt(text)
    np.testing.assert_array_equal(rows[:, :3], result.points)
    assert text.read_text().splitlines()[2].endswith(" 255 0 0")


def test_a_cloud_without_attributes(tmp_path: Path) -> None:
    """A result of points alone is saved in every format."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in "xyz") + "end_header\n"
    rows = np.arange(6, dtype="<f4")
    bare = Result(Meta(), format="ply", data=header.encode() + rows.tobytes())
    assert (bare.normals, bare.colors, bare.scalars) == (None, None, {})
    for extension in ("npz", "npy", "xyz"):
        bare.save(tmp_path / f"bare.{extension}")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "bare.xyz"), rows.reshape(2, 3))


def test_unknown_extension(result: Result, tmp_path: Path) -> None:
    """An unknown extension is refused, and leaves no file."""
    with pytest.raises(SourceError, match=r"\.ply"):
        result.save(tmp_path / "dense.laz")
    assert not list(tmp_path.glob("*.laz"))


@pytest.mark.parametrize("extension", ["npz", "ply"])
def test_a_broken_answer_leaves_the_older_file(tmp_path: Path, extension: str) -> None:
    """A result that cannot be read leaves the older file unchanged, and no temporary one."""
    broken = Result(Meta(), format="json", data=b"{}")
    target = tmp_path / f"dense.{extension}"
    target.write_bytes(b"older")
    with pytest.raises((InvalidResponseError, SourceError)):
        broken.save(target)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_a_result_has_one_place() -> None:
    """A result is either in memory or on disk."""
    with pytest.raises(ValueError, match="memory or on disk"):
        Result(Meta(), format="ply")


def test_names_of_scalars_are_kept(ply_bytes: bytes, tmp_path: Path) -> None:
    """Names beyond ASCII, and one that numpy.savez would not take, are saved and read back."""
    data = ply_bytes.replace(b"float intensity", "float höhe".encode())
    result = Result(Meta(), format="ply", data=data.replace(b"int label", b"int file"))
    again = Result(Meta(), format="npz", path=result.save(tmp_path / "dense.npz"))
    assert set(result.scalars) == set(again.scalars) == {"höhe", "file"}


def test_text_is_saved_under_its_own_extension(tmp_path: Path) -> None:
    """A PLY in ASCII is copied to .ply; other formats would need its arrays."""
    result = Result(Meta(), format="ply-ascii", data=b"ply\n")
    assert result.save(tmp_path / "dense.ply").read_bytes() == b"ply\n"
    with pytest.raises(InvalidResponseError):
        result.save(tmp_path / "dense.npz")


def test_an_answer_that_went_to_a_device(tmp_path: Path) -> None:
    """Reading it back is an error, and does not wait for bytes that never come."""
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (tmp_path / "pipe.ply", tmp_path / "deleted.ply"):
        gone = Result(Meta(), format="ply", path=path)
        for use in (lambda gone=gone: gone.points, lambda gone=gone: gone.save(tmp_path / "a.ply")):
            with pytest.raises(PugeoError, match="read back"):
                use()
        assert gone._repr_html_().startswith("&lt;Result")
