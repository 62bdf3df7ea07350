# SPDX-License-Identifier: Apache-2.0
"""Metrics in base units; names and labels are part of the contract with dashboards."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

__all__ = ["Readings", "Telemetry"]

# A creation time beside every counter doubles the page and tells nobody anything.
disable_created_metrics()  # type: ignore[no-untyped-call]
_SECONDS = (0.005, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600)
_PATCHES = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Readings:
    """Gauges that are read when somebody scrapes, and so can never be stale or leak.

    Attributes:
        queue_patches: patches admitted and not finished.
        queue_capacity: bound on those.
        queue_bytes: bytes of bodies held.
        workers_warm: workers that could run a task.
        workers_missing: workers that should be there and are not.
        workers_lost: workers that ended without being told to, since the start.
        patches_retried: patches begun once more because a worker was lost, since the start.
        jobs_queued: jobs that wait.
        jobs_running: jobs that run.
        jobs_bytes: bytes of their inputs, and of results that are kept.
    """

    queue_patches: int
    queue_capacity: int
    queue_bytes: int
    workers_warm: int
    workers_missing: int
    workers_lost: int
    patches_retried: int = 0
    jobs_queued: int = 0
    jobs_running: int = 0
    jobs_bytes: int = 0


class Telemetry:
    """All metrics of one service, in a registry of their own.

    Args:
        read: returns the current readings.
        version: version of the service.
        model: ``name``, ``version`` and ``sha256`` of the model.
    """

    def __init__(self, read: Callable[[], Readings], version: str, model: dict[str, str]) -> None:
        self.registry = registry = CollectorRegistry()
        self.requests = Counter(
            "pugeo_http_requests",
            "Requests answered; status 499: the client left.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.request_seconds = Histogram(
            "pugeo_http_request_duration_seconds",
            "From the first byte of a request to the last of its answer.",
            ("method", "route"),
            buckets=_SECONDS,
            registry=registry,
        )
        self.in_progress = Gauge(
            "pugeo_http_requests_in_progress", "Requests not yet answered.", registry=registry
        )
        self.queue_wait = Histogram(
            "pugeo_queue_wait_seconds",
            "Time before a worker took a request up.",
            buckets=_SECONDS,
            registry=registry,
        )
        self.batch_patches = Histogram(
            "pugeo_batch_patches",
            "Patches of a batch.",
            buckets=_PATCHES,
            registry=registry,
        )
        self.batch_seconds = Histogram(
            "pugeo_batch_duration_seconds",
            "Time of the network on a batch.",
            buckets=_SECONDS,
            registry=registry,
        )
        self.stage_seconds = Histogram(
            "pugeo_stage_duration_seconds",
            "Time of a stage of a request.",
            ("stage",),
            buckets=_SECONDS,
            registry=registry,
        )
        self.points = Counter(
            "pugeo_points", "Points of clouds upsampled.", ("direction",), registry=registry
        )
        self.rejected = Counter(
            "pugeo_rejected", "Requests refused, by code.", ("reason",), registry=registry
        )
        self.cancelled = Counter(
            "pugeo_cancelled", "Requests ended before their end.", ("reason",), registry=registry
        )
        self.jobs = Counter(
            "pugeo_jobs", "Jobs that came into a state.", ("state",), registry=registry
        )
        build = Gauge("pugeo_build_info", "The service.", ("version",), registry=registry)
        build.labels(version=version).set(1)
        info = Gauge(
            "pugeo_model_info", "The model.", ("model", "version", "sha256"), registry=registry
        )
        info.labels(model["name"], model["version"], model["sha256"]).set(1)
        registry.register(_Read(read))


class _Read(Collector):
    def __init__(self, read: Callable[[], Readings]) -> None:
        self._read = read

    def describe(self) -> list[Metric]:
        # Registering must not ask an engine that has not started yet.
        return []

    def collect(self) -> Iterator[Metric]:
        now = self._read()
        yield GaugeMetricFamily(
            "pugeo_queue_patches", "Patches admitted, not finished.", value=now.queue_patches
        )
        yield GaugeMetricFamily(
            "pugeo_queue_capacity_patches", "Bound on those.", value=now.queue_capacity
        )
        yield GaugeMetricFamily("pugeo_queue_bytes", "Bytes held.", value=now.queue_bytes)
        jobs = GaugeMetricFamily("pugeo_jobs_active", "Jobs not finished.", labels=["state"])
        jobs.add_metric(["queued"], now.jobs_queued)
        jobs.add_metric(["running"], now.jobs_running)
        yield jobs
        yield GaugeMetricFamily("pugeo_jobs_bytes", "Bytes of jobs' files.", value=now.jobs_bytes)
        workers = GaugeMetricFamily("pugeo_workers", "Worker processes.", labels=["state"])
        workers.add_metric(["warm"], now.workers_warm)
        workers.add_metric(["missing"], now.workers_missing)
        yield workers
        restarts = CounterMetricFamily(
            "pugeo_worker_restarts", "Workers that ended by themselves.", labels=["reason"]
        )
        restarts.add_metric(["lost"], now.workers_lost)
        yield restarts
        yield CounterMetricFamily(
            "pugeo_patch_retries",
            "Patches begun once more because a worker was lost.",
            value=now.patches_retried,
        )
