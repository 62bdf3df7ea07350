# SPDX-License-Identifier: Apache-2.0
"""Training batches."""

import numpy as np
import pytest

from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import RATIOS, Batches


def test_probabilities_sum_to_one():
    """Ratios are drawn with probabilities."""
    assert sum(probability for _, probability, _ in RATIOS) == pytest.approx(1.0)


def test_batches_depend_on_seed_and_step_only(shapes):
    """Batch 5 is the same in two data sets, whatever was drawn before."""
    one, two = (Batches(shapes, Mix(), 3, 10) for _ in range(2))
    assert len(one) == 10
    one[0]
    (count, first), (same, second) = one[5], two[5]
    assert count == same
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.patch.points, b.patch.points)
        np.testing.assert_array_equal(a.truths, b.truths)
    other = Batches(shapes, Mix(), 4, 10)[5][1]
    assert other[0].patch.points.tobytes() != first[0].patch.points.tobytes()


def test_a_batch_has_the_size_of_its_ratio(shapes):
    """The number of patches belongs to the number of samples per chart."""
    batches = Batches(shapes, Mix(), 0, 10)
    sizes = {count: patches for count, _, patches in RATIOS}
    for step in range(3):
        count, samples = batches[step]
        assert len(samples) == sizes[count]


def test_truths_belong_to_the_core(shapes):
    """Each ground-truth sample is owned by charts that are trained in this patch."""
    _, samples = Batches(shapes, Mix(), 0, 10)[1]
    for sample in samples:
        core = sample.patch.core
        assert len(sample.truths) > 100
        assert sample.owners.max() < core
        assert sample.near.shape == (core, 12)
        assert sample.noise >= 0.0
        first = sample.patch.points[sample.owners[:, 0]]
        distance = np.linalg.norm(sample.truths - first, axis=1)
        assert (distance < 1.1 * sample.patch.frames.spacing[sample.owners[:, 0]] + 1e-6).all()
