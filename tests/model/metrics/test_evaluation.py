# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")

from pugeo_model.cloud import Cloud
from pugeo_model.formats import write
from pugeo_model.mesh.sampling import poisson_disk


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
    assert row["outward"] == 0.0


def test_signs_are_counted_apart(square):
    """Wrong signs change the fraction of outward normals, not the angles."""
    from pugeo_model.metrics.evaluation import Truth, measure

    flat = np.concatenate(
        [np.random.default_rng(0).uniform(-0.5, 0.5, (400, 2)), np.zeros((400, 1))], axis=1
    )
    normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (400, 1))
    normals[::4] *= -1
    row = measure(flat, normals, flat, Truth(square))
    assert row["outward"] == 75.0
    assert row["normal_mean"] < 1e-5


@pytest.fixture
def samples(ball, tmp_path):
    """Inputs of 300 points and references of 600 for the ball."""
    from pugeo_model.metrics.evaluation import Truth

    truth = Truth(ball)
    for folder, kind, count in (("inputs", "a", 300), ("inputs", "b", 300), ("gt", "600", 600)):
        (tmp_path / folder).mkdir(exist_ok=True)
        points = poisson_disk(truth.vertices, truth.faces, count, np.random.default_rng(len(kind)))
        write(Cloud(points), tmp_path / folder / f"ball_{kind}.ply")
    return tmp_path


def test_a_method_with_known_error(ball, samples):
    """A method that shifts points by 0.001 and 0.002 gets the mean of these as P2F."""
    from pugeo_model.metrics.evaluation import Case, Truth, evaluate

    calls = []

    def lift(cloud, ratio):
        calls.append((len(cloud), ratio))
        unit = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
        points = np.concatenate([cloud.points + 0.001 * unit, cloud.points + 0.002 * unit])
        return Cloud(points, normals=np.tile(unit, (2, 1)))

    cases = [Case("a", 2, 600), Case("b", 2, 600)]
    found = list(evaluate(lift, [Truth(ball)], samples, cases))
    assert calls == [(300, 2), (300, 2)]
    assert [each.case for each in found] == cases
    for each in found:
        assert each.row["P2F"] == pytest.approx(1.5, abs=0.01)
        assert each.row["P2F_std"] == pytest.approx(0.5, abs=0.01)
        assert each.row["normal_mean"] < 2.0
        assert each.row["outward"] == 100.0
        assert each.surface is None


def test_the_limit_is_shared_by_cases(ball, samples):
    """Cases with references of one size have one limit; its points and normals are exact."""
    from pugeo_model.metrics.evaluation import Case, Truth, limit

    cases = [Case("a", 2, 600), Case("b", 2, 600)]
    first, second = limit([Truth(ball)], samples, cases)
    assert [first.case, second.case] == cases
    assert first.row is second.row
    assert first.row["P2F"] < 1e-9
    assert first.row["normal_mean"] < 1e-4
    assert first.row["evenness"] < 0.1
    assert 0 < first.row["CD"] < 100 * np.sqrt(np.pi / 600)
