# SPDX-License-Identifier: Apache-2.0
"""Processors and memory that this process may use."""

import math
import os
from pathlib import Path

__all__ = ["all_memory", "available_cpus", "cgroup_quota"]

_CGROUP = Path("/sys/fs/cgroup")


def cgroup_quota(root: Path = _CGROUP) -> float | None:
    """Return the CPU quota of the control group in processors, or ``None``.

    Args:
        root: mount point of the control groups; version 2 (``cpu.max``) and
            version 1 (``cpu/cpu.cfs_quota_us``) are read.
    """
    try:
        quota, period = (root / "cpu.max").read_text().split()[:2]
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError):
        pass
    try:
        quota_us = int((root / "cpu" / "cpu.cfs_quota_us").read_text())
        period_us = int((root / "cpu" / "cpu.cfs_period_us").read_text())
    except (OSError, ValueError):
        return None
    return quota_us / period_us if quota_us > 0 and period_us > 0 else None


def available_cpus(root: Path = _CGROUP) -> int:
    """Return the number of processors (>= 1) allowed by both affinity and quota.

    ``os.cpu_count`` counts the processors of the host, too many inside a container.
    """
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota = cgroup_quota(root)
    count = affinity or 1
    return max(1, count if quota is None else min(count, math.ceil(quota)))


def all_memory() -> int:
    """Return the bytes of memory that all processes together may use, as Dask counts them."""
    from distributed.system import MEMORY_LIMIT

    return MEMORY_LIMIT
