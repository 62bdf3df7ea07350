# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.partition import partition


@pytest.mark.parametrize("count", [1, 8, 100, 101, 1000, 4097])
def test_parts_are_even(count):
    """Each point is in exactly one part, none is too large, and sizes differ by little."""
    points = np.random.default_rng(0).random((count, 3))
    parts = partition(points, 100)
    assert sorted(np.concatenate(parts)) == list(range(count))
    sizes = [len(part) for part in parts]
    assert max(sizes) <= 100
    assert max(sizes) - min(sizes) <= len(parts).bit_length()


def test_parts_are_compact():
    """Each part of a long strip is a short piece of it."""
    points = np.random.default_rng(0).random((1000, 3)) * [100.0, 1.0, 1.0]
    assert all(np.ptp(points[part, 0]) < 12.5 for part in partition(points, 100))
