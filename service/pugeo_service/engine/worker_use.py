# SPDX-License-Identifier: Apache-2.0
"""Memory and processor time of each worker, from the scheduler's record of it.

Fronts tell them, so that workers need no port that answers without a certificate.
"""

from collections.abc import Mapping
from typing import Any

from pugeo_service.observability.telemetry import WorkerUse

__all__ = ["worker_name", "worker_uses"]


def worker_name(address: str, record: Mapping[str, Any]) -> str:
    """Return the name of a worker: its own, or its address where Dask only counts them."""
    return record["id"] if isinstance(record["id"], str) else address


def worker_uses(records: Mapping[str, Mapping[str, Any]]) -> tuple[WorkerUse, ...]:
    """Return the use of each worker that has reported, in the order of their names.

    Args:
        records: the scheduler's record of each worker, by address.
    """
    return tuple(
        sorted(
            WorkerUse(
                name=worker_name(address, record),
                memory=int(record["metrics"]["memory"]),
                memory_limit=int(record.get("memory_limit") or 0),
                cores=float(record["metrics"]["cpu"]) / 100.0,
            )
            for address, record in records.items()
            if {"memory", "cpu"} <= record["metrics"].keys()
        )
    )
