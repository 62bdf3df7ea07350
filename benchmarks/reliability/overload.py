# SPDX-License-Identifier: Apache-2.0
"""Ten times what the service can do: what it takes is served in time, the rest refused at once."""

import argparse
import asyncio
import itertools
import os
import random
import time
from collections import Counter
from dataclasses import dataclass, field

import httpx2

from benchmarks.reliability.clouds import Ask, Book, ask
from benchmarks.reliability.service import Reply, Server, http, post, probe, served
from benchmarks.reliability.verdict import Claim, quantile, spread, verdict
from pugeo_client import AsyncClient
from pugeo_client.errors import PugeoError

__all__ = ["arguments", "main"]

_POINTS = (2_000, 5_000, 10_000)
_RATIO = 2.0
_BUSY_CLIENTS = 6  # enough that no worker waits for a client
_SLACK_S = 30.0  # beyond the deadline, after which an answer is called missing
_REFUSALS = (429, 503)


@dataclass
class _Storm:
    """Answers while more was asked than the service can do."""

    accepted: list[float] = field(default_factory=list)
    refused: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    without_wait: int = 0
    waits: list[float] = field(default_factory=list)
    probes: list[float] = field(default_factory=list)
    offered: int = 0

    def add(self, reply: Reply) -> None:
        self.statuses[f"{reply.status} {reply.code}".strip()] += 1
        if reply.status == 200:
            self.accepted.append(reply.seconds)
        elif reply.status in _REFUSALS:
            self.refused.append(reply.seconds)
            self.without_wait += reply.retry_after is None
            self.waits.append(reply.retry_after or 0.0)


@dataclass
class _Polite:
    """Clients of the SDK in the midst of it.

    Attributes:
        seconds: of each call, retries and waits included.
        failed: calls that ended with an error.
    """

    seconds: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--seconds", type=float, default=120.0, help="of overload [120]")
    parser.add_argument("--measure", type=float, default=30.0, help="seconds for capacity [30]")
    parser.add_argument("--factor", type=float, default=10.0, help="offered over capacity [10]")
    parser.add_argument(
        "--deadline", type=float, default=600.0, help="of the service [its own: 600]"
    )
    parser.add_argument("--sdk", type=int, default=8, help="clients of the SDK [8]")
    parser.add_argument("--calls", type=int, default=4, help="of each of them [4]")
    parser.add_argument("--retries", type=int, help="of a call [the SDK's own]")
    parser.add_argument("--workers", type=int, default=0, help="of the service [its own choice]")


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    given = ["--workers", str(options.workers), "--deadline-s", str(options.deadline)]
    with served(*given) as server:
        return asyncio.run(_run(server, options))


async def _run(server: Server, options: argparse.Namespace) -> int:
    asks = [ask(points, _RATIO, seed) for points in _POINTS for seed in range(2)]
    book, storm, polite = Book(), _Storm(), _Polite()
    async with http() as client:
        capacity = await _capacity(client, server.url, asks, options.measure, book)
        probing = asyncio.create_task(probe(client, server.url, storm.probes))
        calling = [
            asyncio.create_task(_call(server.url, asks, number, options, polite, book))
            for number in range(options.sdk)
        ]
        await _storm(client, server.url, asks, capacity * options.factor, options, storm, book)
        await asyncio.gather(*calling)
        probing.cancel()
        calm = await post(client, server.url, asks[0], options.deadline)
    return _report(options, capacity, storm, polite, book, calm)


async def _capacity(
    client: httpx2.AsyncClient, url: str, asks: list[Ask], seconds: float, book: Book
) -> float:
    """Requests a second of a service that is busy and not overrun."""
    for asked in asks:  # wakes what is loaded when first used, and fills the book
        book.check(asked, (await post(client, url, asked, 600.0)).body)
    turns, began, done = itertools.cycle(asks), time.monotonic(), 0
    ended = began

    async def work() -> None:
        nonlocal done, ended
        while time.monotonic() - began < seconds:
            asked = next(turns)
            reply = await post(client, url, asked, 600.0)
            if reply.status != 200 or not book.check(asked, reply.body):
                raise RuntimeError(f"{asked.name}: {reply.status} {reply.code}")
            done, ended = done + 1, time.monotonic()

    await asyncio.gather(*(work() for _ in range(_BUSY_CLIENTS)))
    return done / (ended - began)


async def _storm(
    client: httpx2.AsyncClient,
    url: str,
    asks: list[Ask],
    rate: float,
    options: argparse.Namespace,
    storm: _Storm,
    book: Book,
) -> None:
    """Send at a rate, whatever comes back, as people do."""
    rng, sent = random.Random(0), set()
    end = time.monotonic() + options.seconds

    async def one(asked: Ask) -> None:
        reply = await post(client, url, asked, options.deadline + _SLACK_S)
        storm.add(reply)
        if reply.status == 200:
            book.check(asked, reply.body)

    due = time.monotonic()
    while (now := time.monotonic()) < end:
        if now < due:
            await asyncio.sleep(due - now)
        # By the clock and not by the pauses, or a slow answer would lower the rate.
        due += rng.expovariate(rate)
        storm.offered += 1
        task = asyncio.create_task(one(rng.choice(asks)))
        sent.add(task)
        task.add_done_callback(sent.discard)
    await asyncio.gather(*sent)


async def _call(
    url: str, asks: list[Ask], number: int, options: argparse.Namespace, polite: _Polite, book: Book
) -> None:
    """Do one's work with the SDK: its own waits and retries."""
    rng = random.Random(number)
    given = {} if options.retries is None else {"max_retries": options.retries}
    async with AsyncClient(url, timeout=1800.0, **given) as client:
        for _ in range(options.calls):
            asked, began = rng.choice(asks), time.monotonic()
            try:
                result = await client.upsample(asked.body, asked.ratio, seed=asked.seed)
            except PugeoError as error:
                polite.failed.append(f"{asked.name}: {error}")
                continue
            polite.seconds.append(time.monotonic() - began)
            assert result.data is not None
            book.check(asked, result.data)


def _report(
    options: argparse.Namespace,
    capacity: float,
    storm: _Storm,
    polite: _Polite,
    book: Book,
    calm: Reply,
) -> int:
    p99 = quantile(storm.accepted, 0.99)
    answers = ", ".join(f"{n:,} times {status}" for status, n in sorted(storm.statuses.items()))
    other = {s: n for s, n in storm.statuses.items() if s[:3] not in ("200", "429", "503")}
    calls, rate = options.sdk * options.calls, storm.offered / options.seconds
    claims = [
        Claim(
            f"what is accepted is answered within its deadline of {options.deadline:g} s (p99)",
            f"{p99:.1f} s of {len(storm.accepted):,} accepted",
            bool(storm.accepted) and p99 <= options.deadline,
        ),
        Claim("the rest is refused with 429 or 503, and nothing else happens", answers, not other),
        Claim(
            "each refusal says when to come again",
            f"{storm.without_wait} of {len(storm.refused):,} do not",
            storm.without_wait == 0 and bool(storm.refused),
        ),
        Claim(
            f"{options.sdk} clients of the SDK in the midst of it finish all their work",
            f"{len(polite.seconds)} of {calls} calls",
            len(polite.seconds) == calls and not polite.failed,
        ),
        Claim(
            "each answer is right",
            f"{book.right:,} right, {len(book.wrong)} wrong",
            not book.wrong,
        ),
        Claim(
            "afterwards the service serves as before",
            f"{calm.status} in {calm.seconds:.1f} s",
            calm.status == 200,
        ),
    ]
    figures = [
        ("capacity, measured first", f"{capacity:.2f} requests a second"),
        ("offered", f"{rate:.1f} a second, {rate / capacity:.1f} times the capacity"),
        ("served of that", f"{len(storm.accepted) / options.seconds:.2f} a second of the storm"),
        ("accepted: median, p99, worst", spread(storm.accepted, "s")),
        ("refused: median, p99, worst", spread(storm.refused, "ms")),
        ("Retry-After: median, p99, worst", spread(storm.waits, "s")),
        ("calls of the SDK, waits included: median, p99, worst", spread(polite.seconds, "s")),
        ("/health/live meanwhile: median, p99, worst", spread(storm.probes, "ms")),
    ]
    raw = {
        "arguments": {k: v for k, v in vars(options).items() if k != "out"},
        "wrong": book.wrong[:100],
        "failed": polite.failed,
    }
    return verdict("overload", options.out, claims, figures, raw, os.sched_getaffinity(0))
