# SPDX-License-Identifier: Apache-2.0
"""Prometheus metrics in base units; dashboards rely on names and labels."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

__all__ = ["Readings", "Telemetry", "WorkerUse"]

# Creation times of counters would double the page.
disable_created_metrics()  # type: ignore[no-untyped-call]
_SECONDS = (0.005, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600)
_PATCHES = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True, order=True)
class WorkerUse:
    """Use of one worker process, as it last reported it.

    Attributes:
        name: name or address of the worker.
        memory: resident bytes.
        memory_limit: bytes that it may use; 0 if they are unlimited.
        cores: mean number of busy cores.
    """

    name: str
    memory: int
    memory_limit: int
    cores: float


@dataclass(frozen=True)
class Readings:
    """Values of gauges, read at each scrape.

    Attributes:
        queue_patches: patches of requests admitted and not finished.
        queue_capacity: bound on queue_patches.
        queue_bytes: bytes of bodies, and of answers on their way out.
        workers_warm: workers that could run a task.
        workers_missing: configured workers that are not ready.
        workers_lost: workers that ended unexpectedly since the start.
        patches_retried: patches repeated after the loss of a worker since the start.
        jobs_queued: queued jobs.
        jobs_running: running jobs.
        jobs_bytes: bytes of inputs and results of jobs.
        jobs_patches: patches of running jobs that are not finished.
        jobs_capacity: bound on jobs_patches; one job alone may exceed it.
        models: ``name``, ``version`` and ``sha256`` of each model.
        uses: use of each worker.
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
    jobs_patches: int = 0
    jobs_capacity: int = 0
    models: Sequence[dict[str, str]] = ()
    uses: tuple[WorkerUse, ...] = ()


class Telemetry:
    """All metrics of one service, in a separate registry.

    Args:
        read: returns the current readings.
        version: version of the service.
    """

    def __init__(self, read: Callable[[], Readings], version: str) -> None:
        self.registry = registry = CollectorRegistry()
        self.requests = Counter(
            "pugeo_http_requests",
            "Responses by status; 499 if the client disconnected.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.request_seconds = Histogram(
            "pugeo_http_request_duration_seconds",
            "Time from the head of a request to the end of its response.",
            ("method", "route"),
            buckets=_SECONDS,
            registry=registry,
        )
        self.in_progress = Gauge(
            "pugeo_http_requests_in_progress", "Requests in progress.", registry=registry
        )
        self.queue_wait = Histogram(
            "pugeo_queue_wait_seconds",
            "Time until a worker starts a request.",
            buckets=_SECONDS,
            registry=registry,
        )
        self.batch_patches = Histogram(
            "pugeo_batch_patches",
            "Patches per batch of the network.",
            buckets=_PATCHES,
            registry=registry,
        )
        self.batch_seconds = Histogram(
            "pugeo_batch_duration_seconds",
            "Time of the network per batch.",
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
            "pugeo_points", "Points of upsampled clouds.", ("direction",), registry=registry
        )
        self.rejected = Counter(
            "pugeo_rejected",
            "Refused POST requests by code of the problem, and all without a valid key.",
            ("reason",),
            registry=registry,
        )
        self.cancelled = Counter(
            "pugeo_cancelled", "Cancelled requests and jobs.", ("reason",), registry=registry
        )
        self.jobs = Counter(
            "pugeo_jobs", "Changes of jobs by new state.", ("state",), registry=registry
        )
        self.runs = Counter(
            "pugeo_runs",
            "Successful runs by model.",
            ("model", "version", "sha256"),
            registry=registry,
        )
        self.webhooks = Counter(
            "pugeo_webhooks", "Attempts to send a webhook.", ("outcome",), registry=registry
        )
        build = Gauge(
            "pugeo_build_info", "Version of the service.", ("version",), registry=registry
        )
        build.labels(version=version).set(1)
        registry.register(_Read(read))
        # Memory, processor time and descriptors of this process.
        ProcessCollector(registry=registry)


class _Read(Collector):
    def __init__(self, read: Callable[[], Readings]) -> None:
        self._read = read

    def describe(self) -> list[Metric]:
        # Registering must not call an engine that has not started yet.
        return []

    def collect(self) -> Iterator[Metric]:
        now = self._read()
        # Jobs have a queue of their own: they never cause the refusal of a request.
        patches = GaugeMetricFamily(
            "pugeo_queue_patches", "Patches admitted and not finished.", labels=["queue"]
        )
        patches.add_metric(["requests"], now.queue_patches)
        patches.add_metric(["jobs"], now.jobs_patches)
        capacity = GaugeMetricFamily(
            "pugeo_queue_capacity_patches", "Capacity of a queue in patches.", labels=["queue"]
        )
        capacity.add_metric(["requests"], now.queue_capacity)
        capacity.add_metric(["jobs"], now.jobs_capacity)
        yield from (patches, capacity)
        yield GaugeMetricFamily(
            "pugeo_queue_bytes",
            "Bytes of bodies, and of answers on their way out.",
            value=now.queue_bytes,
        )
        jobs = GaugeMetricFamily("pugeo_jobs_active", "Queued and running jobs.", labels=["state"])
        jobs.add_metric(["queued"], now.jobs_queued)
        jobs.add_metric(["running"], now.jobs_running)
        yield jobs
        yield GaugeMetricFamily("pugeo_jobs_bytes", "Bytes of files of jobs.", value=now.jobs_bytes)
        models = GaugeMetricFamily(
            "pugeo_model_info", "Models of the service.", labels=["model", "version", "sha256"]
        )
        for model in now.models:
            models.add_metric([model["name"], model["version"], model["sha256"]], 1)
        yield models
        workers = GaugeMetricFamily("pugeo_workers", "Worker processes.", labels=["state"])
        workers.add_metric(["warm"], now.workers_warm)
        workers.add_metric(["missing"], now.workers_missing)
        yield workers
        memory = GaugeMetricFamily(
            "pugeo_worker_memory_bytes", "Resident memory of a worker.", labels=["worker"]
        )
        limit = GaugeMetricFamily(
            "pugeo_worker_memory_limit_bytes", "Memory that a worker may use.", labels=["worker"]
        )
        cores = GaugeMetricFamily(
            "pugeo_worker_cpu_cores", "Cores that a worker keeps busy.", labels=["worker"]
        )
        for use in now.uses:
            memory.add_metric([use.name], use.memory)
            limit.add_metric([use.name], use.memory_limit)
            cores.add_metric([use.name], use.cores)
        yield from (memory, limit, cores)
        restarts = CounterMetricFamily(
            "pugeo_worker_restarts", "Workers that ended unexpectedly.", labels=["reason"]
        )
        restarts.add_metric(["lost"], now.workers_lost)
        yield restarts
        yield CounterMetricFamily(
            "pugeo_patch_retries",
            "Patches repeated after the loss of a worker.",
            value=now.patches_retried,
        )
