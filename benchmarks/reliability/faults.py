# SPDX-License-Identifier: Apache-2.0
"""SIGKILL for a worker or the whole service, SIGSTOP for a worker, under requests and jobs.

The moments are random.
"""

import argparse
import asyncio
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.reliability.clouds import Ask, Book, ask
from benchmarks.reliability.jobs import JobClient
from benchmarks.reliability.processes import family, psutil
from benchmarks.reliability.restarts import Phoenix
from benchmarks.reliability.service import http, post
from benchmarks.reliability.verdict import Claim, spread, verdict

__all__ = ["arguments", "choose", "main", "replaced"]

_POINTS = (1_000, 3_000, 8_000)
_SEEDS = 3
_RETRY_S = 0.5
_LOST_S = 600.0
_ORPHAN_S = 30.0
# Within which a stopped worker must be gone: five seconds of silence, on a busy machine.
_STOPPED_S = 60.0


@dataclass
class _Account:
    """Faults that were injected, and the reaction of the service.

    Attributes:
        kills: by kind; a worker that is stopped counts too.
        given_up: requests that were not served within ten minutes.
        tries: what came back, by status.
        answered: requests served.
        worker_back_s: seconds from the death of a worker until all were warm.
        service_back_s: seconds from the death of the service until it was ready.
        stopped_gone_s: seconds from the stop of a worker until its process was gone.
        stopped_back_s: seconds from the stop of a worker until all were warm.
        still_stopped: stopped workers that were not replaced in time.
        orphans: processes that outlived their service.
    """

    kills: Counter[str] = field(default_factory=Counter)
    given_up: list[str] = field(default_factory=list)
    tries: Counter[str] = field(default_factory=Counter)
    answered: int = 0
    worker_back_s: list[float] = field(default_factory=list)
    service_back_s: list[float] = field(default_factory=list)
    stopped_gone_s: list[float] = field(default_factory=list)
    stopped_back_s: list[float] = field(default_factory=list)
    still_stopped: int = 0
    orphans: int = 0


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--runs", type=int, default=200, help="faults [200]")
    parser.add_argument("--seconds", type=float, default=0.0, help="stop earlier [never]")
    parser.add_argument("--service-share", type=float, default=0.25, help="killed [0.25]")
    parser.add_argument("--stop-share", type=float, default=0.15, help="workers stopped [0.15]")
    parser.add_argument("--clients", type=int, default=3, help="that send requests [3]")
    parser.add_argument("--job-clients", type=int, default=3, help="that send jobs [3]")
    parser.add_argument("--longest", type=float, default=6.0, help="seconds to a fault [6]")
    parser.add_argument("--seed", type=int, default=1)


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    with tempfile.TemporaryDirectory(prefix="pugeo-") as folder, Phoenix(Path(folder)) as service:
        return asyncio.run(_run(service, options))


async def _run(service: Phoenix, options: argparse.Namespace) -> int:
    asks = [ask(points, 2.0, seed) for points in _POINTS for seed in range(_SEEDS)]
    book, account, over = Book(), _Account(), asyncio.Event()
    began = time.monotonic()
    async with http() as client:
        jobs = JobClient(client, service.url, book)

        async def request(number: int) -> None:
            rng = random.Random(f"{options.seed}:request:{number}")
            while not over.is_set():
                asked = rng.choice(asks)
                if not await _insist(client, service.url, asked, account, book):
                    account.given_up.append(asked.name)

        async def submit(number: int) -> None:
            rng = random.Random(f"{options.seed}:job:{number}")
            while not over.is_set():
                await jobs.run(rng.choice(asks), f"{options.seed}-{number}-{rng.random()}")

        working = [asyncio.create_task(request(number)) for number in range(options.clients)]
        working += [asyncio.create_task(submit(number)) for number in range(options.job_clients)]
        rng = random.Random(options.seed)
        for run in range(options.runs):
            await asyncio.sleep(rng.uniform(0.1, options.longest))
            kind = choose(rng.random(), options.service_share, options.stop_share)
            await _inject(service, kind, rng, account)
            _tell(f"{run + 1} faults, {account.answered} requests, {jobs.succeeded} jobs")
            if options.seconds and time.monotonic() - began > options.seconds:
                break
        over.set()
        _tell("finishing what was accepted")
        await asyncio.gather(*working)
        listed = await jobs.listed()
    return _report(options, book, account, jobs, listed, time.monotonic() - began)


async def _insist(
    client: httpx2.AsyncClient, url: str, asked: Ask, account: _Account, book: Book
) -> bool:
    """Send a request until it is served, as a client that retries would."""
    end = time.monotonic() + _LOST_S
    while time.monotonic() < end:
        reply = await post(client, url, asked, _LOST_S)
        account.tries[f"{reply.status} {reply.code}".strip()] += 1
        if reply.status == 200:
            book.check(asked, reply.body)
            account.answered += 1
            return True
        if reply.status not in (0, 503):
            return False
        await asyncio.sleep(reply.retry_after or _RETRY_S)
    return False


def choose(chance: float, service_share: float, stop_share: float) -> str:
    """Return the kind of a fault for a random number of 0 to 1."""
    if chance < service_share:
        return "service"
    return "stopped worker" if chance < service_share + stop_share else "worker"


async def _inject(service: Phoenix, kind: str, rng: random.Random, account: _Account) -> None:
    workers = [] if kind == "service" else service.server.workers()
    if not workers:
        await _kill_service(service, account)
        return
    began, worker = time.monotonic(), rng.choice(workers)
    account.kills[kind] += 1
    if kind == "worker":
        worker.kill()
        await asyncio.to_thread(service.until_all_warm)
        account.worker_back_s.append(time.monotonic() - began)
        return
    worker.suspend()
    if await asyncio.to_thread(replaced, worker, _STOPPED_S):
        account.stopped_gone_s.append(time.monotonic() - began)
        await asyncio.to_thread(service.until_all_warm)
        account.stopped_back_s.append(time.monotonic() - began)
    else:
        account.still_stopped += 1


def replaced(worker: Any, seconds: float) -> bool:
    """Wait until the service has ended a stopped worker; let it go on if that takes too long."""
    _, alive = psutil.wait_procs([worker], seconds)
    for process in alive:
        process.resume()
    return not alive


async def _kill_service(service: Phoenix, account: _Account) -> None:
    before = family(service.server.process.pid)
    os.kill(service.server.process.pid, signal.SIGKILL)
    account.kills["service"] += 1
    # Workers end themselves once the process that started them is gone.
    _, alive = await asyncio.to_thread(psutil.wait_procs, before[1:], _ORPHAN_S)
    account.orphans += len(alive)
    began = time.monotonic()
    await asyncio.to_thread(service.rise)
    account.service_back_s.append(time.monotonic() - began)


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _report(
    options: argparse.Namespace,
    book: Book,
    account: _Account,
    jobs: JobClient,
    listed: int,
    seconds: float,
) -> int:
    kills = sum(account.kills.values())
    shown = ", ".join(f"{n} of {what}" for what, n in sorted(account.kills.items()))
    refused = {
        s: n for s, n in account.tries.items() if s[:3] not in ("200", "503") and s[0] != "0"
    }
    claims = [
        Claim(
            "no accepted job is lost: each succeeds, however often the service dies",
            f"{jobs.succeeded} of {jobs.accepted} succeeded; {'; '.join(jobs.lost) or 'none lost'}",
            jobs.succeeded == jobs.accepted > 0 and not jobs.lost,
        ),
        Claim(
            "nothing is done twice: a request sent again under its key is the same job",
            f"{listed} jobs for {jobs.accepted} keys, {jobs.resent} sent again, "
            f"{len(jobs.doubled)} doubled",
            listed == jobs.accepted and not jobs.doubled,
        ),
        Claim(
            "each request is served to a client that retries, with no status but 200 and 503",
            f"{account.answered} served, {len(account.given_up)} not; "
            f"{sum(refused.values())} of another status",
            account.answered > 0 and not account.given_up and not refused,
        ),
        Claim(
            "no answer and no result is wrong, or other than before",
            f"{book.right} right, {len(book.wrong)} wrong",
            not book.wrong,
        ),
        Claim(
            f"a stopped worker is ended within {_STOPPED_S:g} s, and another one comes",
            f"{len(account.stopped_back_s)} were, {account.still_stopped} were not",
            not account.still_stopped,
        ),
        Claim("no process outlives its service", f"{account.orphans} did", not account.orphans),
    ]
    tries = ", ".join(f"{n} times {status}" for status, n in sorted(account.tries.items()))
    figures = [
        ("faults", f"{kills}: {shown}; in {seconds:.0f} s"),
        ("from the kill of a worker until all are warm", spread(account.worker_back_s, "s")),
        ("from the stop of a worker until it is gone", spread(account.stopped_gone_s, "s")),
        ("from the stop of a worker until all are warm", spread(account.stopped_back_s, "s")),
        ("from the restart of the service until it is ready", spread(account.service_back_s, "s")),
        ("what came back of requests (0: the connection broke)", tries),
    ]
    raw = {
        "arguments": {k: v for k, v in vars(options).items() if k != "out"},
        "wrong": book.wrong,
        "given_up": account.given_up,
        "lost": jobs.lost,
        "doubled": jobs.doubled,
        "tries": dict(account.tries),
    }
    status = verdict("faults", options.out, claims, figures, raw, os.sched_getaffinity(0))
    if kills < options.runs:
        print(f"stopped after {kills} of {options.runs} faults")
    return status
