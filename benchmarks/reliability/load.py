# SPDX-License-Identifier: Apache-2.0
"""Many clients, small and large clouds, for minutes: right answers, no error, no growth."""

import argparse
import asyncio
import itertools
import os
import random
import time
from collections import Counter
from dataclasses import dataclass, field

import httpx2

from benchmarks.reliability.clouds import REACH, Ask, Book, ask
from benchmarks.reliability.processes import Watch
from benchmarks.reliability.service import Reply, Server, http, post, probe, served
from benchmarks.reliability.verdict import Claim, spread, verdict

__all__ = ["arguments", "main"]

# Points of a cloud, and how often it is asked for.
_MIX = {2_000: 50, 5_000: 20, 10_000: 14, 20_000: 8, 50_000: 5, 100_000: 2, 200_000: 1}
_SMALL = 5_000
_RATIOS = (1.5, 2.0, 4.0)
_WARM_CLIENTS = 4
_GROWTH = 0.10
_MINUTE_S = 60.0
_LATE_S = 900.0


@dataclass
class _Tally:
    """Answers under load."""

    statuses: Counter[str] = field(default_factory=Counter)
    seconds: dict[int, list[float]] = field(default_factory=dict)
    points_out: int = 0
    impatient: int = 0

    def add(self, asked: Ask, reply: Reply, *, late: bool) -> None:
        self.statuses[f"{reply.status} {reply.code}".strip()] += 1
        if reply.status == 200:
            self.seconds.setdefault(asked.points, []).append(reply.seconds)
            self.points_out += 0 if late else asked.points_out
        elif reply.status in (429, 503) and reply.retry_after is None:
            self.impatient += 1


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--seconds", type=float, default=300.0, help="how long [300]")
    parser.add_argument("--clients", type=int, default=64, help="at the same time [64]")
    parser.add_argument("--largest", type=int, default=200_000, help="points of a cloud [200000]")
    parser.add_argument("--workers", type=int, default=0, help="of the service [its own choice]")


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    with served("--workers", str(options.workers)) as server:
        return asyncio.run(_run(server, options))


async def _run(server: Server, options: argparse.Namespace) -> int:
    mix = {points: weight for points, weight in _MIX.items() if points <= options.largest}
    asks = {points: _asks(points) for points in mix}
    probes: list[float] = []
    book, tally = Book(), _Tally()
    async with http() as client:
        warmed = await _warm(client, server.url, list(itertools.chain(*asks.values())), book)
        workers = {worker.pid for worker in server.workers()}
        with Watch(server.process.pid) as watch:
            end = time.monotonic() + options.seconds
            probing = asyncio.create_task(probe(client, server.url, probes))

            async def work(number: int) -> None:
                rng = random.Random(number)
                while time.monotonic() < end:
                    points = rng.choices(list(mix), list(mix.values()))[0]
                    asked = rng.choice(asks[points])
                    reply = await post(client, server.url, asked, _LATE_S)
                    tally.add(asked, reply, late=time.monotonic() > end)
                    if reply.status == 200:
                        book.check(asked, reply.body)
                    else:
                        await asyncio.sleep(min(reply.retry_after or 1.0, 5.0))

            clients = [asyncio.create_task(work(number)) for number in range(options.clients)]
            await asyncio.sleep(options.seconds)
            probing.cancel()
        # Memory and points a second are those of the load; what was accepted is finished as well.
        await asyncio.gather(*clients)
    same = workers == {worker.pid for worker in server.workers()}
    return _report(options, book, tally, probes, watch, warmed, same)


def _asks(points: int) -> list[Ask]:
    ratios = _RATIOS if points <= 20_000 else _RATIOS[1:2]
    return [ask(points, ratio, seed) for seed, ratio in enumerate(ratios)]


async def _warm(client: httpx2.AsyncClient, url: str, asks: list[Ask], book: Book) -> float:
    """Ask for everything twice, so that answers are known and memory has its size."""
    began = time.monotonic()
    waiting = [*asks, *asks]

    async def work() -> None:
        while waiting:
            asked = waiting.pop()
            reply = await post(client, url, asked, _LATE_S)
            if reply.status != 200:
                raise RuntimeError(f"{asked.name}: {reply.status} {reply.code}")
            book.check(asked, reply.body)

    await asyncio.gather(*(work() for _ in range(_WARM_CLIENTS)))
    return time.monotonic() - began


def _report(
    options: argparse.Namespace,
    book: Book,
    tally: _Tally,
    probes: list[float],
    watch: Watch,
    warmed: float,
    same_workers: bool,
) -> int:
    served_all = sum(map(len, tally.seconds.values()))
    small = [s for points, spent in tally.seconds.items() if points <= _SMALL for s in spent]
    share = min(_MINUTE_S / options.seconds, 0.2 if options.seconds < 5 * _MINUTE_S else 1.0)
    growth = watch.growth(share)
    errors = {status: n for status, n in tally.statuses.items() if status[:3] not in ("200", "503")}
    claims = [
        Claim(
            "no answer but 200, and 503 where the queue is full",
            ", ".join(f"{n:,} times {status}" for status, n in sorted(tally.statuses.items())),
            not errors and served_all > 0,
        ),
        Claim("each 503 says when to come again", f"{tally.impatient} do not", not tally.impatient),
        Claim(
            f"each answer is right: exactly R M points, none further than {REACH:g} spacings from "
            "the true surface, the same bytes each time",
            f"{book.right:,} right, {len(book.wrong)} wrong; furthest {book.furthest:.3f} spacings",
            not book.wrong,
        ),
        Claim(
            f"memory is flat: within {100 * _GROWTH:.0f} % from the first "
            f"{share * options.seconds:.0f} s to the last",
            f"{100 * growth:+.1f} %",
            growth <= _GROWTH,
        ),
        Claim("no worker was replaced", "none" if same_workers else "some", same_workers),
    ]
    peak = max(sample.rss for sample in watch.samples)
    ended = [sample.rss for sample in watch.samples][-1]
    figures = [
        ("clients, seconds", f"{options.clients}, {options.seconds:g}"),
        ("warm-up, each request twice", f"{warmed:.0f} s"),
        ("requests served", f"{served_all:,}"),
        ("points out a second", f"{tally.points_out / options.seconds:,.0f}"),
        (f"up to {_SMALL:,} points under this load: median, p99, worst", spread(small, "s")),
        *(
            (f"{points:,} points: median, p99, worst", spread(spent, "s"))
            for points, spent in sorted(tally.seconds.items())
        ),
        ("/health/live meanwhile: median, p99, worst", spread(probes, "ms")),
        (
            "memory of all processes: at the end, at most",
            f"{ended / 2**20:,.0f}, {peak / 2**20:,.0f} MiB",
        ),
        ("memory of the front: growth", f"{100 * watch.growth(share, front=True):+.1f} %"),
    ]
    raw = {
        "arguments": {k: v for k, v in vars(options).items() if k != "out"},
        "wrong": book.wrong[:100],
        "rss": [[round(s.at - watch.samples[0].at, 1), s.rss, s.front_rss] for s in watch.samples],
    }
    return verdict("load", options.out, claims, figures, raw, os.sched_getaffinity(0))
