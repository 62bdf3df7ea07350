# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

pytest.importorskip("igl", reason="evaluation needs the train extra")


@pytest.fixture
def square(tmp_path):
    """A unit square in the plane z = 0, as a mesh file."""
    path = tmp_path / "square.off"
    path.write_text("OFF\n4 2 0\n-.5 -.5 0\n.5 -.5 0\n.5 .5 0\n-.5 .5 0\n3 0 1 2\n3 0 2 3\n")
    return path


def test_known_offset_and_tilt(square):
    """Points 0.002 above a square with normals off by 5 degrees are measured as such."""
    from pugeo_model.metrics.evaluation import Truth, measure

    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-0.5, 0.5, (500, 2)), np.zeros((500, 1))], axis=1)
    tilt = np.radians(5.0)
    normals = np.tile([np.sin(tilt), 0.0, -np.cos(tilt)], (500, 1))
    row = measure(flat + [0, 0, 0.002], normals, flat, Truth(square))
    assert row["P2F"] == pytest.approx(2.0)
    assert row["P2F_std"] == pytest.approx(0.0, abs=1e-9)
    assert row["CD"] == pytest.approx(0.2)
    assert row["normal_mean"] == pytest.approx(5.0)
    assert row["normal_rms"] == pytest.approx(5.0)
    assert row["normal_below_10"] == 100.0


def test_poisson_disk_is_exact_and_even(square):
    """The limit's sample has the number of points asked for, on the mesh, evenly spread."""
    from pugeo_model.metrics.clouds import evenness
    from pugeo_model.metrics.evaluation import Truth
    from pugeo_model.training.corpus import poisson_disk

    truth = Truth(square)
    points = poisson_disk(truth.vertices, truth.faces, 1000, np.random.default_rng(0))
    assert points.shape == (1000, 3)
    assert np.abs(points[:, 2]).max() == 0.0
    assert evenness(points) < 0.1
