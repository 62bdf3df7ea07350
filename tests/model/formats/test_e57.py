# SPDX-License-Identifier: Apache-2.0
"""E57, compared with pye57."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud, LimitExceededError, MalformedFileError, UnsupportedFormatError
from pugeo_model.formats import read, write
from pugeo_model.formats.e57 import library

pye57: Any = pytest.importorskip("pye57", reason="its wheel is missing on some platforms")

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]
TURN = np.array([0.8, 0.0, 0.6, 0.0])
ROWS = 300


def scan(seed: int) -> dict[str, NDArray[Any]]:
    """Columns of a scan in which every tenth point is invalid."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.normal(size=(3, ROWS))
    return {
        "cartesianX": x,
        "cartesianY": y,
        "cartesianZ": z,
        "intensity": rng.random(ROWS).astype(np.float32),
        "colorRed": rng.integers(0, 256, ROWS).astype(np.uint8),
        "colorGreen": rng.integers(0, 256, ROWS).astype(np.uint8),
        "colorBlue": rng.integers(0, 256, ROWS).astype(np.uint8),
        "cartesianInvalidState": (np.arange(ROWS) % 10 == 0).astype(np.int8),
    }


@pytest.fixture
def two_scans(tmp_path: Path) -> Path:
    """A file of pye57 with two scans, each with a pose."""
    path = tmp_path / "made.e57"
    with pye57.E57(str(path), mode="w") as file:
        for number in range(2):
            place = np.array([5e5 + 10 * number, 4e6, 7.0])
            file.write_scan_raw(scan(number), rotation=TURN, translation=place)
    return path


def test_reads_as_pye57(two_scans: Path) -> None:
    """Poses move points, are their viewpoints, and invalid points are left out with a note."""
    cloud = read(two_scans)
    with pye57.E57(str(two_scans)) as file:
        scans = [file.read_scan(i, intensity=True, colors=True) for i in range(2)]
    points = np.concatenate([[s[f"cartesian{a}"] for a in "XYZ"] for s in scans], axis=1).T
    np.testing.assert_allclose(cloud.points, points, rtol=0, atol=1e-9)
    colors = np.concatenate([[s[f"color{c}"] for c in ("Red", "Green", "Blue")] for s in scans], 1)
    np.testing.assert_array_equal(cloud.colors, colors.T)
    intensity = np.concatenate([s["intensity"] for s in scans])
    np.testing.assert_array_equal(cloud.scalars["intensity"], intensity)
    assert cloud.scalars["scan"].tolist() == [0] * 270 + [1] * 270
    assert cloud.viewpoints is not None
    assert cloud.viewpoints.tolist() == [[5e5, 4e6, 7], [5e5 + 10, 4e6, 7]]
    assert cloud.notes == ("60 points that the file marks as invalid are left out.",)


def test_round_trip(two_scans: Path, dump: Dump, parse: Parse, tmp_path: Path) -> None:
    """Scans, poses, normals, colours and intensities come back; the same cloud, the same bytes."""
    old = read(two_scans)
    normals = np.random.default_rng(2).normal(size=old.points.shape).astype(np.float32)
    cloud = Cloud(
        old.points, normals, old.colors, old.scalars, viewpoints=old.viewpoints, source=old.source
    )
    data = dump(cloud, "e57")
    back = parse(data)
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(back.normals, normals)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    np.testing.assert_array_equal(back.viewpoints, cloud.viewpoints)
    for name, values in cloud.scalars.items():
        np.testing.assert_array_equal(back.scalars[name], values)
    assert dump(cloud, "e57") == data
    path = tmp_path / "ours.e57"
    path.write_bytes(data)
    with pye57.E57(str(path)) as file:
        theirs = file.read_scan(1, intensity=True, colors=True, ignore_missing_fields=True)
        top = file.get_header(0).intensityMaximum
    np.testing.assert_allclose(theirs["cartesianX"], cloud.points[270:, 0], rtol=0, atol=1e-9)
    assert top == cloud.scalars["intensity"][:270].max()


def test_wide_colors_and_missing_intensities(dump: Dump, parse: Parse) -> None:
    """Colours of 16 bits stay so, missing intensities stay missing, float32 stays exact."""
    rng = np.random.default_rng(0)
    intensity = rng.random(20).astype(np.float32)
    intensity[3] = np.nan
    cloud = Cloud(
        rng.normal(size=(20, 3)).astype(np.float32),
        colors=rng.integers(0, 65536, (20, 3)).astype(np.uint16),
        scalars={"intensity": intensity, "returnIndex": np.arange(20, dtype=np.uint8)},
    )
    back = parse(dump(cloud, "e57"))
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    np.testing.assert_array_equal(back.scalars["intensity"], intensity)
    assert back.scalars["returnIndex"].tolist() == list(range(20))
    assert back.viewpoints is None


def test_broken_files(two_scans: Path, parse: Parse) -> None:
    """Truncated files and wrong checksums are refused; declared points are bounded."""
    data = two_scans.read_bytes()
    with pytest.raises(MalformedFileError):
        parse(data[:2000])
    with pytest.raises(MalformedFileError):
        parse(data[:3000] + bytes([data[3000] ^ 1]) + data[3001:])
    with pytest.raises(LimitExceededError, match="Points of the E57 scans"):
        parse(data, max_points=2 * ROWS - 1)


def test_without_the_library(
    two_scans: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without pye57 the error names the extra to install."""
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(UnsupportedFormatError, match="pip install pye57"):
        read(two_scans)
    with pytest.raises(UnsupportedFormatError, match="pip install pye57"):
        write(Cloud(np.zeros((1, 3))), tmp_path / "a.e57")


def test_path_of_a_file(two_scans: Path) -> None:
    """A real file is read where it is; anything else from a copy that goes afterwards."""
    with two_scans.open("rb") as file, library.on_disk(file) as path:
        assert path == str(two_scans)
    with library.on_disk(io.BytesIO(b"abc")) as path:
        copy = Path(path)
        assert copy.read_bytes() == b"abc"
    assert not copy.exists()
