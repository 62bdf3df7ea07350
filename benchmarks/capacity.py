# SPDX-License-Identifier: Apache-2.0
"""Costs of a million points in each process, and of workers that a front and a scheduler feed.

``python -m benchmarks.capacity [--workers 1 2 4] [--model fast]`` starts a cluster of a scheduler,
workers and a front on this machine and sends it two loads: several clients with clouds of one task
each, and one large cloud. It prints the processor seconds and the bytes of each process for a
million points of the answer, the measured points a second beside those of a simulation with these
costs, and the simulation of larger clusters, in which each process has a core of its own.
"""

import argparse
import heapq
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import surface
from benchmarks.machine import describe
from benchmarks.reliability.processes import family, psutil
from benchmarks.reliability.service import Server, served
from benchmarks.report import table
from pugeo_client import Client
from pugeo_model.cpus import available_cpus

__all__ = ["main", "simulate"]

_ROOT = Path(__file__).resolve().parents[1]
_EACH, _REQUESTS = 10_000, 32
_RATIO = 4.0
_PATIENCE_S = 3600.0
_LARGER = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_MILLION = 1e6


@dataclass(frozen=True)
class Cost:
    """Expenses of one process, or of all of one kind.

    Attributes:
        seconds: of the processor.
        bytes: read and written, through sockets and files.
    """

    seconds: float
    bytes: float

    def __sub__(self, other: "Cost") -> "Cost":
        return Cost(self.seconds - other.seconds, self.bytes - other.bytes)


@dataclass(frozen=True)
class Load:
    """One measured load.

    Attributes:
        points: of all answers.
        seconds: it took.
        costs: kind of process -> its cost.
    """

    points: float
    seconds: float
    costs: dict[str, Cost]

    def per_million(self, kind: str) -> Cost:
        """The cost of a kind of process for a million points."""
        millions = self.points / _MILLION
        return Cost(self.costs[kind].seconds / millions, self.costs[kind].bytes / millions)


@dataclass
class Cluster:
    """Processes on this machine.

    Attributes:
        front: the service.
        pids: kind of process -> process ids; those of workers include their children.
    """

    front: Server
    pids: dict[str, list[int]]

    def costs(self) -> dict[str, Cost]:
        """Return the expenses of each kind since its start."""
        own = psutil.Process()
        found = {kind: _cost([p for pid in pids for p in family(pid)])
                 for kind, pids in self.pids.items()}  # fmt: skip
        return {**found, "client": _cost([own])}


def main() -> None:
    """Measure, simulate, and print Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capacity", description=__doc__)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--points", type=int, default=1_000_000, help="of the large cloud")
    parser.add_argument("--model", default="standard", help="name of the weights")
    options = parser.parse_args()
    print("\n".join(table(("", ""), describe(None, options.model))), end="\n\n")
    seen: dict[int, dict[str, Load]] = {}
    for workers in options.workers:
        print(f"measuring {workers} workers ...", file=sys.stderr, flush=True)
        seen[workers] = _measure(workers, options)
    kinds = ("client", "front", "scheduler", "worker")
    rows = []
    for workers, loads in seen.items():
        for name, load in loads.items():
            costs = [load.per_million(kind) for kind in kinds]
            rows.append((
                str(workers), name,
                *(f"{cost.seconds:.2f} s, {cost.bytes / 1e6:,.0f} MB" for cost in costs),
            ))  # fmt: skip
    print("For a million points of the answer:\n")
    print("\n".join(table(("workers", "load", *kinds), rows)), end="\n\n")
    _compare(seen)
    _extrapolate(seen[max(seen)])


def _measure(workers: int, options: argparse.Namespace) -> dict[str, Load]:
    with _cluster(workers, options) as cluster:
        clouds = [_even(_EACH + 7 * more) for more in range(_REQUESTS)]
        clients = 2 * workers
        with ExitStack() as inside, ThreadPoolExecutor(clients) as threads:
            connected = [
                inside.enter_context(Client(cluster.front.url, timeout=_PATIENCE_S))
                for _ in range(clients)
            ]

            def send(number: int) -> int:
                cloud = clouds[number % _REQUESTS]
                return len(connected[number % clients].upsample(cloud, ratio=_RATIO).points)

            list(threads.map(send, range(clients)))
            before, began = cluster.costs(), time.monotonic()
            points = sum(threads.map(send, range(_REQUESTS)))
            small = _load(cluster, before, began, points)
        with Client(cluster.front.url, timeout=_PATIENCE_S) as client:
            large = _even(options.points)
            before, began = cluster.costs(), time.monotonic()
            points = len(client.upsample(large, ratio=_RATIO).points)
            return {"many": small, "large": _load(cluster, before, began, points)}


def _load(cluster: Cluster, before: dict[str, Cost], began: float, points: int) -> Load:
    seconds = time.monotonic() - began
    after = cluster.costs()
    return Load(points, seconds, {kind: after[kind] - before[kind] for kind in after})


@contextmanager
def _cluster(workers: int, options: argparse.Namespace) -> Iterator[Cluster]:
    """Start a scheduler, workers and a front, with certificates of their own."""
    with tempfile.TemporaryDirectory(prefix="pugeo-") as name, ExitStack() as running:
        folder = Path(name)
        make = [sys.executable, str(_ROOT / "deploy/make_certs.py"), name]
        subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
        tls = {f"PUGEO_TLS_{part.upper()}": str(folder / f"{part}.pem")
               for part in ("ca", "cert", "key")}  # fmt: skip
        environment = {
            **tls,
            "PUGEO_MODEL": options.model,
            "PUGEO_WORKERS": str(workers),
            "PUGEO_SPOOL_DIR": name,
            "PUGEO_MAX_POINTS": str(options.points + _EACH + 7 * _REQUESTS),
            "PUGEO_QUEUE_PATCHES": str(options.points),
            "PUGEO_DEADLINE_S": str(_PATIENCE_S),
        }
        scheduler = running.enter_context(_process(["scheduler", "--port", "0"], environment))
        assert scheduler.stdout is not None
        address = scheduler.stdout.readline().split()[-1]
        named = {**environment, "PUGEO_SCHEDULER": address}
        host = running.enter_context(_process(["worker"], named))
        front = running.enter_context(served(**named))
        while front.metric('pugeo_workers{state="warm"}') < workers:
            time.sleep(0.5)
        pids = {"front": [front.process.pid], "scheduler": [scheduler.pid], "worker": [host.pid]}
        yield Cluster(front, pids)


@contextmanager
def _process(command: list[str], environment: dict[str, str]) -> Iterator["subprocess.Popen[str]"]:
    arguments = [sys.executable, "-c", "from pugeo_model.cli import main; main()", *command]
    process = subprocess.Popen(
        arguments, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait(60)


def _cost(processes: list[Any]) -> Cost:
    seconds = transferred = 0.0
    for process in processes:
        times, io = process.cpu_times(), process.io_counters()
        seconds += times.user + times.system
        transferred += io.read_chars + io.write_chars
    return Cost(seconds, transferred)


def simulate(
    workers: int, clients: int, front_s: float, worker_s: float, scheduler_s: float
) -> float:
    """Simulate requests in a closed loop; return requests a second.

    Each request is received by the front, placed by the scheduler, computed by a worker and sent by
    the front. Front and scheduler have one core, each worker one; all queues are first come, first
    served.

    Args:
        workers: their number.
        clients: each sends its next request when it has the answer to the last one.
        front_s: processor seconds of the front for a request, half of it before the worker.
        worker_s: of the worker.
        scheduler_s: of the scheduler.
    """
    steps = (("front", front_s / 2), ("scheduler", scheduler_s), ("worker", worker_s),
             ("front", front_s / 2))  # fmt: skip
    free = {"front": [0.0], "scheduler": [0.0], "worker": [0.0] * workers}
    order = itertools.count()
    # Time of arrival at a step, order of arrival, the step.
    events = [(0.0, next(order), 0) for _ in range(clients)]
    heapq.heapify(events)
    done, warm, enough, began = 0, 4 * clients, 40 * clients, 0.0
    while True:
        at, _, step = heapq.heappop(events)
        station, seconds = steps[step]
        end = max(at, heapq.heappop(free[station])) + seconds
        heapq.heappush(free[station], end)
        if step + 1 < len(steps):
            heapq.heappush(events, (end, next(order), step + 1))
            continue
        done += 1
        if done == warm:
            began = end
        elif done == warm + enough:
            return enough / (end - began)
        heapq.heappush(events, (end, next(order), 0))


def _compare(seen: dict[int, dict[str, Load]]) -> None:
    """Print measured and simulated speeds; here all processes share the cores of this machine."""
    cores = available_cpus()
    rows = []
    for workers, loads in seen.items():
        load = loads["many"]
        spent = {kind: cost.seconds / _REQUESTS for kind, cost in load.costs.items()}
        free = simulate(workers, 2 * workers, spent["front"], spent["worker"], spent["scheduler"])
        bound = cores / sum(spent.values())
        simulated = min(free, bound) * load.points / _REQUESTS
        rows.append((str(workers), f"{load.points / load.seconds:,.0f}", f"{simulated:,.0f}"))
    print(f"Several clients, on {cores} cores that all processes share, points a second:\n")
    print("\n".join(table(("workers", "measured", "simulated"), rows)), end="\n\n")


def _extrapolate(loads: dict[str, Load]) -> None:
    """Print the simulation of larger clusters, each process with a core of its own."""
    rows = []
    for workers in _LARGER:
        row = [str(workers)]
        for load in loads.values():
            costs = {kind: load.per_million(kind).seconds for kind in load.costs}
            rate = simulate(
                workers, 2 * workers + 2, costs["front"], costs["worker"], costs["scheduler"]
            )
            busiest = max(costs["front"], costs["scheduler"])
            row += [f"{60 * rate:,.0f}", f"{100 * rate * busiest:.0f} %"]
        rows.append(tuple(row))
    names = [
        text for name in loads for text in (f"{name}: M points/min", "front or scheduler busy")
    ]
    print("One front and one scheduler, a core for each process:\n")
    print("\n".join(table(("workers", *names), rows)))


def _even(points: int) -> NDArray[np.float32]:
    return surface.spiral(points).astype(np.float32)


if __name__ == "__main__":
    main()
