# SPDX-License-Identifier: Apache-2.0
"""Even patterns on a disk."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.network import pattern
from pugeo_model.network.pattern import disk


@pytest.mark.parametrize("count", [1, 4, 32, 64, 65, 200, 1000])
def test_samples_are_even(count: int) -> None:
    """All samples lie in the disk of area 1, around 0, at nearly equal distances."""
    samples = disk(count)
    assert samples.shape == (count, 2)
    assert np.abs(samples.mean(axis=0)).max() < 1e-6
    assert np.linalg.norm(samples, axis=1).max() <= 1 / np.sqrt(np.pi)
    if count >= 32:
        nearest = np.asarray(cKDTree(samples).query(samples, k=2)[0])[:, 1]
        assert nearest.std() < 0.12 * nearest.mean()
        assert nearest.mean() > 0.85 / np.sqrt(count)


def test_many_samples_cost_no_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """The nearest samples of a large pattern are found by a tree, not among all pairs."""
    built: list[int] = []

    def counted(samples: NDArray[np.float64]) -> cKDTree:
        built.append(len(samples))
        return cKDTree(samples)

    monkeypatch.setattr(pattern, "cKDTree", counted)
    disk.__wrapped__(500)
    assert built == [500] * 10
