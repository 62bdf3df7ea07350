# SPDX-License-Identifier: Apache-2.0
"""Samples for the evaluation: the files that it reads, on the surface, the same in each run."""

from pathlib import Path

import igl
import numpy as np
import pytest

from pugeo_model.formats import read
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.mesh.files import read_mesh
from pugeo_model.metrics import samples
from pugeo_model.metrics.evaluation import CASES, evaluate, truths
from pugeo_model.metrics.samples import write_samples

CUBE = np.array([[x, y, z] for x in (0, 30) for y in (0, 30) for z in (0, 20)], np.float64)


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """A folder with a box of 30 x 30 x 20, in another place and format than evaluated ones."""
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    (tmp_path / "meshes").mkdir()
    igl.write_triangle_mesh(str(tmp_path / "meshes" / "box.off"), CUBE + 100, faces)
    return tmp_path / "meshes"


@pytest.mark.slow
def test_the_evaluation_reads_them(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All cases find their files; sizes, noise and distances are those that their names promise."""
    out = tmp_path / "samples"
    assert list(write_samples(meshes, out)) == [("box", 1, 1)]
    vertices, faces = read_mesh(out / "meshes" / "box.ply")
    assert np.ptp(vertices, axis=0).tolist() == pytest.approx([1, 1, 2 / 3])
    surface = MeshDistance(vertices, faces)
    radius = np.linalg.norm(vertices, axis=1).max()
    for path in [*(out / "inputs").iterdir(), *(out / "gt").iterdir()]:
        cloud = read(path)
        size = int(path.stem.split("_")[1])
        distances = surface.nearest(cloud.points.astype(np.float64))[0]
        sigma = {"noise01": 0.01, "noise02": 0.02}.get(path.stem.rpartition("_")[2], 0.0)
        assert len(cloud) == size
        # The mean of |N(0, sigma)|, as far as the box is flat.
        expected = sigma * radius * (2 / np.pi) ** 0.5
        assert distances.mean() == pytest.approx(expected, rel=0.15, abs=1e-6)
    shapes = list(truths(out / "meshes"))
    found = list(evaluate(lambda cloud, _ratio: cloud, shapes, out))
    assert [each.case for each in found] == list(CASES)
    # Drawn again, and without the other cases, each file is the same.
    monkeypatch.setattr(samples, "CASES", CASES[2:3])
    list(write_samples(meshes, tmp_path / "again"))
    for name in ("inputs/box_2048.ply", "gt/box_8192.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()


def test_what_is_no_mesh(tmp_path: Path) -> None:
    """A folder without meshes, and a mesh without faces, are errors that name them."""
    with pytest.raises(FileNotFoundError, match="no mesh"):
        list(write_samples(tmp_path, tmp_path / "out"))
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(ValueError, match=r"points\.obj has no triangles"):
        list(write_samples(tmp_path, tmp_path / "out"))
