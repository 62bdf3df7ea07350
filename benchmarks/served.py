# SPDX-License-Identifier: Apache-2.0
"""Speed and memory of a service: ``python -m benchmarks.served [--points N] [--ratio R]``.

``--workers 2`` leaves out the service of one worker; ``--rounds 3`` measures three times, in turn,
and shows medians: a machine is not as fast at one time as at another.

A service of two workers and one of a single worker are started one after the other on all cores of
this process: how soon they are ready, how soon a small cloud comes back when nobody else is there,
how many points come out in a second when several clients send at once and of one large cloud, and
the resident memory of front and workers together, shared pages counted in each.
"""

import argparse
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from threading import local

import numpy as np
from numpy.typing import NDArray

from benchmarks import surface
from benchmarks.machine import describe
from benchmarks.reliability.processes import Watch, family
from benchmarks.reliability.service import Server, served
from benchmarks.report import table
from pugeo_client import Client

__all__ = ["main"]

_SMALL, _SMALL_TIMES = 2_000, 25
_EACH, _REQUESTS, _CLIENTS = 10_000, 32, 4
_RATIO = 4.0
_LOOK_S = 0.2
_PATIENCE_S = 3600.0


@dataclass(frozen=True)
class Seen:
    """Figures of one service.

    Attributes:
        ready: seconds from its start.
        latency: seconds, of a small cloud, in the median.
        many: points a second to several clients.
        large: points a second of the large cloud.
        idle: bytes before the large cloud.
        peak: bytes at most on its way.
    """

    ready: float
    latency: float
    many: float
    large: float
    idle: int
    peak: int


def main() -> None:
    """Measure both services and print Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.served", description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000, help="of the large cloud")
    parser.add_argument("--ratio", type=float, default=8.0, help="of the large cloud")
    parser.add_argument("--model", default="standard", help="name or path of the weights")
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 1], help="of each service")
    parser.add_argument("--rounds", type=int, default=1, help="of all services")
    options = parser.parse_args()
    print("\n".join(table(("", ""), describe(None, options.model))), end="\n\n")
    cloud = _even(options.points)
    rounds = [
        {workers: _seen(workers, cloud, options) for workers in options.workers}
        for _ in range(options.rounds)
    ]
    seen = {workers: _median([each[workers] for each in rounds]) for workers in options.workers}
    rows = [
        (
            str(workers),
            f"{each.ready:.1f} s",
            f"{1e3 * each.latency:.0f} ms",
            f"{each.many:,.0f}",
            f"{each.large:,.0f}",
            f"{each.idle / 2**20:,.0f} MiB",
            f"{each.peak / 2**20:,.0f} MiB",
        )
        for workers, each in seen.items()
    ]
    large = f"{options.points:,} x{options.ratio:g}"
    header = (
        "workers",
        "ready after",
        f"{_SMALL:,} x{_RATIO:g}, median",
        f"{_CLIENTS} clients, {_EACH:,} x{_RATIO:g}, points a second",
        f"{large}, points a second",
        "memory before",
        "at most",
    )
    print("\n".join(table(header, rows)))
    if {1, 2} <= set(seen):
        ratios = [
            statistics.median(getattr(each[2], name) / getattr(each[1], name) for each in rounds)
            for name in ("many", "large")
        ]
        print("\nTwo workers to one: {:.2f}, {:.2f}.".format(*ratios))


def _median(seen: list[Seen]) -> Seen:
    """The median of each figure, of memory the most."""
    middle = {
        name: statistics.median(getattr(each, name) for each in seen)
        for name in ("ready", "latency", "many", "large")
    }
    return Seen(
        **middle, idle=max(each.idle for each in seen), peak=max(each.peak for each in seen)
    )


def _seen(workers: int, cloud: NDArray[np.float32], options: argparse.Namespace) -> Seen:
    print(f"measuring with {workers} workers ...", file=sys.stderr, flush=True)
    began = time.monotonic()
    environment = {
        "PUGEO_WORKERS": str(workers),
        "PUGEO_MODEL": options.model,
        # The large cloud may be beyond what a service takes by default.
        "PUGEO_MAX_POINTS": str(options.points + _EACH + 7 * _REQUESTS),
        "PUGEO_MAX_OUTPUT_POINTS": str(32 * (options.points + _EACH + 7 * _REQUESTS)),
        "PUGEO_QUEUE_PATCHES": str(options.points + _EACH),
        "PUGEO_DEADLINE_S": str(_PATIENCE_S),
    }
    with served(**environment) as server, Client(server.url, timeout=_PATIENCE_S) as client:
        ready = time.monotonic() - began
        small = _even(_SMALL)
        latency = statistics.median(_seconds(client, small) for _ in range(_SMALL_TIMES))
        many = _many(server)
        idle = sum(each.memory_info().rss for each in family(server.process.pid))
        with Watch(server.process.pid, _LOOK_S) as watch:
            began = time.monotonic()
            answer = client.upsample(cloud, ratio=options.ratio)
            large = len(answer.points) / (time.monotonic() - began)
    peak = max(sample.rss for sample in watch.samples)
    return Seen(ready, latency, many, large, idle, peak)


def _many(server: Server) -> float:
    """Points a second of requests whose clouds all differ in size, several at a time."""
    clouds = [_even(_EACH + 7 * more) for more in range(_REQUESTS)]

    # Each client keeps its connection, as clients do: making one anew costs it 20 ms.
    here = local()

    def send(cloud: NDArray[np.float32]) -> float:
        return _seconds(here.client, cloud)

    def connect() -> None:
        here.client = inside.enter_context(Client(server.url, timeout=_PATIENCE_S))

    with ExitStack() as inside, ThreadPoolExecutor(_CLIENTS, initializer=connect) as clients:
        list(clients.map(send, clouds[:_CLIENTS]))
        began = time.monotonic()
        list(clients.map(send, clouds))
        spent = time.monotonic() - began
    return _RATIO * sum(map(len, clouds)) / spent


def _even(points: int) -> NDArray[np.float32]:
    return surface.spiral(points).astype(np.float32)


def _seconds(client: Client, cloud: NDArray[np.float32]) -> float:
    began = time.monotonic()
    client.upsample(cloud, ratio=_RATIO)
    return time.monotonic() - began


if __name__ == "__main__":
    main()
