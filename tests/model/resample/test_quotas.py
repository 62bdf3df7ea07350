# SPDX-License-Identifier: Apache-2.0
"""Quotas: candidates of charts in proportion to the points that they stand for."""

import numpy as np

from pugeo_model.resample.quotas import chosen_candidates


def test_candidates_in_proportion() -> None:
    """Twice the quota, twice the candidates, spread over those of the chart."""
    quotas = np.array([1.0, 2.0, 1.0, 4.0])
    chosen = chosen_candidates(quotas, 8.0, 16, 100)
    assert np.bincount(chosen // 100, minlength=4).tolist() == [4, 8, 4, 16]
    assert (chosen[chosen // 100 == 3] % 100).max() > 90


def test_charts_without_enough_candidates_are_made_up_for() -> None:
    """A few charts that stand for nearly all points have too few candidates for them."""
    quotas = np.ones(100)
    quotas[:3] = 500.0
    wanted = 1000
    chosen = chosen_candidates(quotas, quotas.sum(), wanted, 20)
    count = np.bincount(chosen // 20, minlength=100)
    assert count.max() == 20
    assert 1.3 * wanted < len(chosen) <= 1.5 * wanted
    assert len(np.unique(chosen)) == len(chosen)


def test_all_candidates_where_all_are_needed() -> None:
    """No more candidates are chosen than there are."""
    quotas = np.array([1.0, 3.0])
    assert len(chosen_candidates(quotas, 4.0, 100, 10)) == 20
