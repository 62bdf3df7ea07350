# SPDX-License-Identifier: Apache-2.0
"""Suites whose inputs are made from the meshes, on small counts of a ball."""

import json

import pytest
from typer.testing import CliRunner

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")

import igl

from pugeo_model.cli import app
from pugeo_model.mesh.virtual_sensors import SENSORS
from pugeo_model.metrics import denoising_suite, normals_suite, sensor_suite
from pugeo_model.metrics.evaluation import Truth
from pugeo_model.metrics.suites import evaluate_suite
from pugeo_model.upsampler import Upsampler


@pytest.fixture
def meshes(ball, tmp_path):
    """A folder of one mesh."""
    truth = Truth(ball)
    (tmp_path / "meshes").mkdir()
    igl.write_triangle_mesh(str(tmp_path / "meshes/ball.ply"), truth.vertices, truth.faces)
    return tmp_path / "meshes"


def test_denoising(monkeypatch, ball):
    """Less is left of the noise than there was, where it is wide and where it is not."""
    monkeypatch.setattr(denoising_suite, "_COUNTS", (1500,))
    found = {(name, method): row["left"] for name, method, row in rows(denoising_suite, ball)}
    assert len(found) == 6
    for name in ("1,500 points, 1 %", "1,500 points, 2 %"):
        assert 0.0 < found[name, "moved"] < 1.0
        assert found[name, "moved"] < found[name, "limit"]  # few independent points lie far apart


def test_normals(monkeypatch, ball):
    """Six conditions; ours and three PCAs; noise makes all of them worse."""
    monkeypatch.setattr(normals_suite, "_COUNT", 1500)
    found = {(name, method): row["normal_rms"] for name, method, row in rows(normals_suite, ball)}
    assert len({name for name, _ in found}) == 6
    assert {method for _, method in found} == {"ours", "PCA 16", "PCA 64", "PCA 256"}
    assert found["clean", "ours"] < 5.0
    assert found["clean", "PCA 16"] < found["noise 1.2 %", "PCA 16"]


@pytest.mark.slow
def test_sensors(tmp_path, meshes, monkeypatch):
    """Each sensor has its scan, two answers and the limit, on the surface that was seen."""
    pytest.importorskip("trimesh", reason="virtual sensors need the train extra")
    pytest.importorskip("embreex", reason="virtual sensors need the train extra")
    # One that sees a part, one that sees all around, one with a lattice.
    few = {name: SENSORS[name] for name in ("rings", "photos", "voxels")}
    monkeypatch.setattr(sensor_suite, "SENSORS", few)
    out = tmp_path / "rows.json"
    text = evaluate_suite("sensors", "fast", meshes, out)
    found = json.loads(out.read_text("utf-8"))
    assert {key.split("/")[1] for key in found} == {"input", "ours", "even", "limit"}
    assert len(found) == 4 * len({key.split("/")[0] for key in found}) == 4 * 3
    assert "| rings | ours |" in text
    for key, by_shape in found.items():
        row = by_shape["ball"]
        if key.endswith("limit"):
            assert (row["P2F"], row["stray"]) == (pytest.approx(0, abs=1e-6), 0)
            assert row["density"] < 0.3
    assert found["photos/even"]["ball"]["density"] < found["photos/input"]["ball"]["density"]


def test_the_command(meshes):
    """An unknown suite names those there are; without one, samples are needed."""
    wrong = CliRunner().invoke(app, ["evaluate", "--meshes", str(meshes), "--suite", "all"])
    assert wrong.exit_code == 2
    assert "sensors, denoising, normals" in " ".join(wrong.output.split())
    both = CliRunner().invoke(
        app, ["evaluate", "--meshes", str(meshes), "--suite", "normals", "--card"]
    )
    assert both.exit_code == 2
    assert "leave out --card" in " ".join(both.output.split())
    none = CliRunner().invoke(app, ["evaluate", "--meshes", str(meshes)])
    assert none.exit_code == 2
    assert "--samples" in none.output


def rows(suite, ball):
    """Rows of a suite on the ball."""
    return list(suite.rows(Upsampler("fast"), Truth(ball)))
