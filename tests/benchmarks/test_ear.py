# SPDX-License-Identifier: Apache-2.0
"""EAR by CGAL, which is installed by hand where it is wanted."""

from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip("igl", reason="samples of solids need the evaluate extra")

from benchmarks.ear import ear

from pugeo_model.cloud import Cloud
from pugeo_model.reproduce.solids import sphere


@pytest.mark.skipif(find_spec("CGAL") is None, reason="needs pip install cgal")
def test_ear():
    """Exactly R M points near the sphere, with outward normals."""
    cloud = Cloud(sphere(1000).points)
    dense = ear(cloud, 4.0)
    assert len(dense) == 4000
    assert np.abs(np.linalg.norm(dense.points, axis=1) - 0.5).max() < 0.02
    assert dense.normals is not None
    assert (dense.normals * dense.points).sum(axis=1).min() > 0.4
