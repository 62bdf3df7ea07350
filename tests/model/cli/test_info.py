# SPDX-License-Identifier: Apache-2.0
"""``pugeo info``."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.formats import write

Run = Callable[..., Any]


@pytest.fixture
def plane(tmp_path: Path) -> Path:
    """A plane of 40 x 40 points, 0.5 apart, with attributes, a duplicate and a missing point."""
    side = np.arange(40) * 0.5
    points = np.stack([*np.meshgrid(side, side), np.zeros((40, 40))], axis=-1).reshape(-1, 3)
    points = np.concatenate([points, points[:1], [[np.nan] * 3]]) + [1000.0, 2000.0, 30.0]
    count = len(points)
    cloud = Cloud(
        points,
        colors=np.zeros((count, 3), np.uint8),
        scalars={"intensity": np.linspace(0, 1, count), "label": np.ones(count, np.int32)},
    )
    write(cloud, tmp_path / "plane.ply")
    return tmp_path / "plane.ply"


def test_json(pugeo: Run, plane: Path) -> None:
    """All that is measured is right for a plane whose measures are known."""
    done = pugeo("info", plane, "--json", "-R", 8)
    assert done.status == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["format"], told["points"], told["coordinates"]) == ("ply", 1602, "float64")
    assert told["bytes"] == plane.stat().st_size
    assert told["bounds"] == [[1000, 2000, 30], [1019.5, 2019.5, 30]]
    assert told["size"] == [19.5, 19.5, 0]
    # The mean distance to the 8 nearest of a square grid: (4 + 4 sqrt 2) / 8 of its step.
    assert told["spacing"]["median"] == pytest.approx(0.5 * (1 + 2**0.5) / 2, rel=1e-5)
    assert told["spacing"]["p10"] <= told["spacing"]["median"] <= told["spacing"]["p90"]
    assert told["noise"]["units"] == pytest.approx(0.0, abs=1e-4)
    assert {name: each["becomes"] for name, each in told["attributes"].items()} == {
        "colors": "interpolated",
        "intensity": "interpolated",
        "label": "that of the nearest point",
    }
    assert told["crs"] is None
    assert told["work"] == {
        "dropped": {"non_finite": 1, "wild": 0, "duplicate": 1}, "ratio": 8.0, "points_out": 12_800,
        "denoised": False, "orient": "mst", "tiles": 1, "patches": 1, "format": "ply",
    }  # fmt: skip


def test_text(pugeo: Run, plane: Path) -> None:
    """The same for a person."""
    done = pugeo("info", plane)
    text = done.stdout.decode()
    assert text.startswith(f"{plane}: ply, 1,602 points, float64\n")
    for words in (
        "from        1000, 2000, 30",
        "spacing     0.6036",
        "label (int32): that of the nearest point",
        "CRS         none",
        "6,400 points at -R 4, as ply",
        "drops 1 non-finite and 1 duplicate points",
        "normals: mst; 1 tiles, 1 patches",
    ):
        assert words in text


def test_a_coordinate_system_and_stdin(pugeo: Run) -> None:
    """The CRS of a LAS file has its name, and stdin can be described."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    wkt = 'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89"]]'
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(0).normal(size=(50, 3)) * [10, 10, 0.1]
    file = io.BytesIO()
    las.write(file, do_compress=True)
    done = pugeo("info", "-", stdin=file.getvalue())
    assert done.status == 0, done.stderr
    assert "-: laz, 50 points" in done.stdout.decode()
    assert "CRS         ETRS89 / UTM zone 32N" in done.stdout.decode()


def test_what_cannot_be_upsampled(pugeo: Run, tmp_path: Path, scan: Run) -> None:
    """A cloud without a surface is described with the problem; a broken file is an error."""
    few = Cloud(np.eye(3, dtype=np.float32))
    write(few, tmp_path / "few.ply")
    done = pugeo("info", tmp_path / "few.ply")
    assert done.status == 0
    assert "problem" in done.stdout.decode()
    (tmp_path / "empty.ply").touch()
    done = pugeo("info", tmp_path / "empty.ply", scan("a.ply"), "--json")
    assert done.status == 3
    bad, good = (json.loads(line) for line in done.stdout.splitlines())
    assert bad["error"] == "The file is empty."
    assert good["points"] == 300
