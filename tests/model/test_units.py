# SPDX-License-Identifier: Apache-2.0
"""Warnings about degrees and about steps of float32."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.units import coordinate_warnings


def hill(count: int = 3000) -> NDArray[np.float64]:
    """A hill of 200 m in a field of 1 km."""
    xy = np.random.default_rng(0).uniform(-500, 500, (count, 2))
    height = 200 * np.exp(-(xy**2).sum(axis=1) / 5e4)
    return np.column_stack([xy, height])


def test_metres() -> None:
    """A cloud in metres, a tall pole, and a single point have no warning."""
    assert coordinate_warnings(hill()) == ()
    assert coordinate_warnings(hill() + [448_262, 5_411_932, 0]) == ()
    assert coordinate_warnings(hill().astype(np.float32)) == ()
    assert coordinate_warnings(hill() * [1e-4, 1e-4, 0.05]) == ()
    assert coordinate_warnings(np.zeros((1, 3))) == ()
    assert coordinate_warnings(np.array([[-1e308, 0, 0], [1e308, 0, 0]])) == ()


def test_degrees_beside_metres() -> None:
    """Degrees for x and y beside metres for z are noticed, and reach the report."""
    points = hill() / [111_000, 111_000, 1] + [8.5, 47.3, 400]
    assert "degrees" in coordinate_warnings(points)[0]
    assert "degrees" in make_plan(Cloud(points), Options(2.0)).report["notes"][0]


@pytest.mark.parametrize("double", [False, True])
def test_steps_of_float32(double: bool) -> None:
    """Georeferenced points that went through float32 are noticed, also when they are double now."""
    near = hill() / 1000 + [448_262, 5_411_932, 251]
    coarse = np.unique(near.astype(np.float32), axis=0)
    warnings = coordinate_warnings(coarse.astype(np.float64) if double else coarse)
    assert "steps are 0.5" in warnings[0]
    assert coordinate_warnings(near) == ()
