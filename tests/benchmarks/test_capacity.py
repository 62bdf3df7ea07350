# SPDX-License-Identifier: Apache-2.0
"""The simulated cluster is as fast as its slowest part, which one can compute with a pencil."""

import pytest

pytest.importorskip("benchmarks", reason="not part of a source distribution")

from benchmarks.capacity import simulate


def test_one_worker_alone() -> None:
    """Without other costs the rate is that of the worker."""
    assert simulate(1, 4, 0.0, 0.5, 0.0) == pytest.approx(2.0)


def test_one_client_waits_for_each_step() -> None:
    """Nothing overlaps for a single client: the seconds of all steps add up."""
    assert simulate(8, 1, 0.2, 0.5, 0.1) == pytest.approx(1 / 0.8)


@pytest.mark.parametrize("workers", [2, 8])
def test_few_workers_are_all_busy(workers: int) -> None:
    """While front and scheduler have time left, each further worker adds its own rate."""
    rate = simulate(workers, 4 * workers, 0.01, 1.0, 0.01)
    assert rate == pytest.approx(workers, rel=0.02)


def test_the_front_bounds_many_workers() -> None:
    """However many workers there are, the front needs its time for each request."""
    assert simulate(1000, 2000, 0.02, 1.0, 0.01) == pytest.approx(50.0, rel=0.02)


def test_the_scheduler_bounds_many_workers() -> None:
    """So does the scheduler, if it is the slower one."""
    assert simulate(1000, 2000, 0.01, 1.0, 0.02) == pytest.approx(50.0, rel=0.02)


def test_the_table_of_several_machines() -> None:
    """The costs that docs/performance.md tells give the figures that stand there."""
    found = {}
    for workers in (8, 32, 64, 128):
        rate = simulate(workers, 2 * workers + 2, 0.66, 44.88, 0.46)
        found[workers] = (round(60 * rate), round(100 * rate * 0.66))
    assert found == {8: (11, 12), 32: (43, 47), 64: (86, 94), 128: (91, 100)}
