# SPDX-License-Identifier: Apache-2.0
"""Number of processors of this process."""

import os
from pathlib import Path

import pytest

from pugeo_model.cpus import available_cpus, cgroup_quota


def test_a_quota_of_the_second_kind(tmp_path: Path) -> None:
    """``cpu.max`` is read as processors."""
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    assert cgroup_quota(tmp_path) == 1.5


def test_no_quota_of_the_second_kind(tmp_path: Path) -> None:
    """The word max means no quota."""
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert cgroup_quota(tmp_path) is None


def test_a_quota_of_the_first_kind(tmp_path: Path) -> None:
    """Older kernels keep quota and period in two files."""
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("50000\n")
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert cgroup_quota(tmp_path) == 0.5


def test_no_quota_of_the_first_kind(tmp_path: Path) -> None:
    """In version 1, -1 means no quota."""
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("-1\n")
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert cgroup_quota(tmp_path) is None


def test_no_control_groups(tmp_path: Path) -> None:
    """Without control groups there is no quota."""
    assert cgroup_quota(tmp_path) is None


@pytest.mark.parametrize(("quota", "expected"), [("10000 100000", 1), ("110000 100000", 2)])
def test_a_share_of_a_processor_counts_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: str, expected: int
) -> None:
    """Fractions are rounded up."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    (tmp_path / "cpu.max").write_text(quota)
    assert available_cpus(tmp_path) == expected


def test_affinity_binds_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process pinned to three processors has three, even if the quota allows more."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5, 7})
    (tmp_path / "cpu.max").write_text("800000 100000")
    assert available_cpus(tmp_path) == 3
