# SPDX-License-Identifier: Apache-2.0
"""What makes the pipeline fast stays: ratios of processor times, never seconds.

Bounds leave room for a busy machine. What each would be today stands beside it: a bound that is
broken means that something was lost, not that the machine had a bad day.
"""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("benchmarks", reason="not part of a source distribution")

from benchmarks.guard import Ratios
from benchmarks.one_core import environment

pytestmark = pytest.mark.slow


@pytest.fixture(name="ratios", scope="module")
def _ratios(root: Path) -> Ratios:
    """Measured in a process of its own: threads of other tests would count as its time."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.guard"],
        cwd=root,
        env=environment(),
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
    )
    return Ratios.from_json(done.stdout)


def test_time_grows_with_the_points(ratios: Ratios) -> None:
    """Four times the points take about four times as long: 1.04 of the rate."""
    assert ratios.linearity > 0.6


def test_the_ratio_is_cheap(ratios: Ratios) -> None:
    """R=16 takes less than twice the time of R=4: charts are computed once a point."""
    assert ratios.density < 3.0


def test_the_network_is_what_takes_time(ratios: Ratios) -> None:
    """Preparing, merging and finishing together take 0.25 of the network's time."""
    assert ratios.rest < 1.0


def test_a_cloud_of_a_new_size_costs_the_same(ratios: Ratios) -> None:
    """No product is compiled anew for numbers of rows never met: 1.0, and 1.4 if they are."""
    assert ratios.novelty < 1.25


def test_the_network_keeps_up_with_its_products(ratios: Ratios) -> None:
    """It reaches 0.46 of the rate of large matrix products on a core of its own.

    A busy neighbour takes more from a network than from one short product at its best.
    """
    if ratios.roofline is None:
        pytest.skip("bfloat16 is emulated here, or has matrix units")
    assert ratios.roofline > 0.2
