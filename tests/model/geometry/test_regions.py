# SPDX-License-Identifier: Apache-2.0
"""Compact regions of a cloud and their principal axes."""

import numpy as np

from pugeo_model.geometry.regions import nested_regions


def test_each_size_has_four_of_the_one_before() -> None:
    """Regions are nested, and of about equal size."""
    points = np.random.default_rng(0).uniform(size=(5000, 3))
    regions = nested_regions(points)
    assert [len(region.count) for region in regions] == [64, 16, 4, 1]
    for region in regions:
        assert region.count.sum() == 5000
        assert np.ptp(region.count) <= 1
    np.testing.assert_array_equal(regions[1].of_point, regions[0].of_point // 4)


def test_the_axes_of_a_plate() -> None:
    """A plate of 4 x 2, with a noise of 0.1."""
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(0, 4, 4000), rng.uniform(0, 2, 4000), rng.normal(0, 0.1, 4000)]
    whole = nested_regions(points)[-1]
    assert len(whole.count) == 1
    np.testing.assert_allclose(np.abs(whole.axis[0]), [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(
        [whole.first[0], whole.second[0], whole.third[0]],
        [4 / np.sqrt(12), 2 / np.sqrt(12), 0.1],
        rtol=0.05,
    )
    np.testing.assert_allclose(whole.side, 2.0, rtol=0.05)
    assert whole.spreads_two_ways.all()


def test_few_points_are_one_region() -> None:
    """Fewer points than the smallest region has are one, and too few to tell."""
    (whole,) = nested_regions(np.random.default_rng(2).normal(size=(20, 3)))
    assert whole.count.tolist() == [20]
    assert not whole.spreads_two_ways.any()


def test_quantiles_of_some_points() -> None:
    """Only known values count; a region without any has no median."""
    points = np.r_[np.zeros((50, 3)), np.ones((50, 3))] + np.arange(100)[:, None] * 1e-6
    region = nested_regions(points)[0]
    values = np.arange(100.0)
    known = values < 40
    medians = np.sort(region.medians(values, known))
    assert medians[0] == 20.0
    assert np.isinf(medians[1:]).all()


def test_larger_sizes_continue_the_smaller_ones() -> None:
    """Sizes from a later one on are those that a longer list has there, or none."""
    points = np.random.default_rng(5).normal(size=(5000, 3))
    all_sizes = nested_regions(points)
    some = nested_regions(points, start=2)
    assert len(some) == len(all_sizes) - 2 > 0
    assert (some[0].of_point == all_sizes[2].of_point).all()
    assert nested_regions(points, start=9) == []
