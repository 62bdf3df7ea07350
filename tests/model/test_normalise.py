# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model import UntreatableCloudError
from pugeo_model.normalise import normalise


def test_round_trip_of_georeferenced_doubles():
    """UTM coordinates in millimetres come back to the micrometre."""
    rng = np.random.default_rng(0)
    points = rng.random((1000, 3)) * 50 + [432_100.123, 5_412_345.678, 612.9]
    unit, placement = normalise(points)
    assert np.abs(unit).max() == pytest.approx(0.5)
    assert np.ptp(unit, axis=0).max() == pytest.approx(1.0)
    back = placement.world(unit)
    assert back.dtype == np.float64
    assert np.abs(back - points).max() < 1e-6


def test_float32_stays_float32():
    """The answer has the precision of the question."""
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    unit, placement = normalise(points)
    assert unit.dtype == np.float64
    assert placement.world(unit).dtype == np.float32


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e12, 1e150, 1e308])
def test_any_magnitude(scale):
    """Clouds of any finite size are treated, without overflow."""
    points = (np.random.default_rng(0).random((50, 3)) - 0.5) * scale
    unit, placement = normalise(points)
    assert np.isfinite(unit).all()
    np.testing.assert_allclose(placement.world(unit), points, rtol=1e-9, atol=scale * 1e-12)


def test_too_few_points():
    """Seven points are refused, and the error says how many are needed."""
    with pytest.raises(UntreatableCloudError, match="at least 8") as caught:
        normalise(np.random.default_rng(0).random((7, 3)))
    assert caught.value.code == "too_few_points"


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_points_on_a_line(offset):
    """Points of one line are refused, also where float32 makes it a little crooked."""
    line = np.linspace(0, 1, 100)[:, None] * [1.0, 2.0, -3.0] + offset
    for points in (line, line.astype(np.float32)):
        if offset and points.dtype == np.float32:
            continue  # rounding there is larger than a thin but real strip
        with pytest.raises(UntreatableCloudError) as caught:
            normalise(points)
        assert caught.value.code == "collinear_points"


def test_flat_cloud_is_fine(plane):
    """A plane is a surface."""
    unit, _ = normalise(plane[0])
    assert len(unit) == len(plane[0])
