# SPDX-License-Identifier: Apache-2.0
"""More than a service has room for: event streams, connections and columns."""

import argparse
import asyncio
import io
import os
import random
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import httpx2
import numpy as np

from benchmarks.reliability import hostile
from benchmarks.reliability.clouds import Ask, Book, ask
from benchmarks.reliability.processes import Watch
from benchmarks.reliability.service import Server, http, internal_errors, post, probe, served
from benchmarks.reliability.verdict import Claim, spread, verdict
from pugeo_service.keys import Entry, hash_of, new_token

__all__ = ["arguments", "columns", "main"]

# The bound of the service on all event streams; one key may hold half of them.
_STREAMS = 1000
_CONNECTIONS = 32
_PROBE_S = 1.0
_GOOD_S = 600.0
_BREATH_S = 0.1
_RATIO = 32.0
_COLUMNS = 1000
_ROWS = 9_000
_TIMES = 20
_WORK_S = 1.0
_LINES = 5  # of the log, beside one a minute about refused connections
_TOO_LARGE = frozenset({"413 too_many_output_bytes", "413 too_much_memory"})


@dataclass
class _Account:
    """Answers to floods, by status and code, and what others met meanwhile."""

    streams: Counter[str] = field(default_factory=Counter)
    other_key: int = 0
    connections: Counter[str] = field(default_factory=Counter)
    columns: Counter[str] = field(default_factory=Counter)
    columns_s: list[float] = field(default_factory=list)
    columns_work_s: float = 0.0
    good: list[float] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    stream_probes: list[float] = field(default_factory=list)
    connection_probes: list[float] = field(default_factory=list)
    lines: int = 0
    descriptors: int = 0
    internal: float = 0.0


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--seconds", type=float, default=60.0, help="of each flood [60]")
    parser.add_argument("--streams", type=int, default=800, help="of one key [800]")
    parser.add_argument("--connections", type=int, default=200, help="that send nothing [200]")
    parser.add_argument("--points", type=int, default=200_000, help="of the job watched [200000]")


def columns(rows: int = _ROWS, count: int = _COLUMNS) -> bytes:
    """Return a small archive of a large cloud: constant columns deflate to nothing."""
    buffer = io.BytesIO()
    ones: dict[str, Any] = {f"s{number}": np.ones(rows) for number in range(count)}
    np.savez_compressed(buffer, points=np.zeros((rows, 3), np.float32), **ones)
    return buffer.getvalue()


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    account, book = _Account(), Book()
    tokens = {name: new_token() for name in ("flood", "good")}
    keys = ",".join(str(Entry(name, hash_of(token))) for name, token in tokens.items())
    with served("--workers", "1", PUGEO_API_KEYS=keys) as server:
        asyncio.run(_watch_one_job(server, tokens, options, account, book))
        account.internal += _errors(server)
    with served("--workers", "1", PUGEO_MAX_CONNECTIONS=str(_CONNECTIONS)) as server:
        asyncio.run(_send_columns(server, account, book))
        before = _warnings(server)
        asyncio.run(_connect(server, options, account, book))
        account.lines = _warnings(server) - before
        account.internal += internal_errors(server)
    return _report(options, account, book)


async def _watch_one_job(
    server: Server,
    tokens: dict[str, str],
    options: argparse.Namespace,
    account: _Account,
    book: Book,
) -> None:
    """Open hundreds of event streams of a job with one key."""
    async with _keyed(tokens["flood"]) as flood, _keyed(tokens["good"]) as good:
        asked = ask(options.points, 4.0)
        path = await _submitted(flood, server.url, asked)
        probing = asyncio.create_task(probe(good, server.url, account.stream_probes))
        answered = asyncio.Semaphore(0)
        streams = [
            asyncio.create_task(
                _stream(server, f"{path}/events", tokens["flood"], account, answered)
            )
            for _ in range(options.streams)
        ]
        for _ in streams:
            await answered.acquire()
        mine = await _submitted(good, server.url, asked)
        async with good.stream("GET", f"{server.url}{mine}/events") as response:
            account.other_key = response.status_code
        await good.delete(f"{server.url}{mine}")
        await _ask_meanwhile(good, server, options.seconds, account, book)
        await _ended(probing, account)
        await flood.delete(f"{server.url}{path}")
        for stream in streams:
            stream.cancel()
        await asyncio.gather(*streams, return_exceptions=True)


async def _stream(
    server: Server, path: str, token: str, account: _Account, answered: asyncio.Semaphore
) -> None:
    """Read one event stream to its end."""
    # Without a client of HTTP: hundreds of connections would make that the slowest part.
    reader, writer = await asyncio.open_connection(*_address(server))
    try:
        head = f"GET {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\n\r\n"
        writer.write(head.encode())
        _, status, *_ = (await reader.readline() or b"- none").split()
        account.streams[status.decode()] += 1
        answered.release()
        while await reader.read(1 << 16):
            pass
    finally:
        writer.close()


async def _send_columns(server: Server, account: _Account, book: Book) -> None:
    """Ask for many points with a thousand columns, again and again."""
    asked = Ask(_ROWS, _RATIO, 0, columns())
    async with http() as client:
        await _ask_meanwhile(client, server, 0.0, account, book)
        before = _processor_s(server)
        for _ in range(_TIMES):
            reply = await post(client, server.url, asked, _GOOD_S)
            account.columns[f"{reply.status} {reply.code}".strip()] += 1
            account.columns_s.append(reply.seconds)
        account.columns_work_s = (_processor_s(server) - before) / _TIMES


async def _connect(
    server: Server, options: argparse.Namespace, account: _Account, book: Book
) -> None:
    """Open more connections than the service has room for, and send nothing."""
    address = _address(server)
    end = time.monotonic() + options.seconds
    watch = Watch(server.process.pid)

    async def idle(number: int) -> None:
        rng = random.Random(number)
        while time.monotonic() < end:
            try:
                for status in await hostile.half_open(address, rng) or ("no answer",):
                    account.connections[status] += 1
            except OSError:
                account.connections["no connection"] += 1
            await asyncio.sleep(_BREATH_S)

    # Each client has a connection before the flood begins, and keeps it.
    async with http() as probes, http() as good:
        probing = asyncio.create_task(probe(probes, server.url, account.connection_probes))
        await _ask_meanwhile(good, server, 0.0, account, book)
        idling = [asyncio.create_task(idle(number)) for number in range(options.connections)]
        await _ask_meanwhile(good, server, options.seconds, account, book)
        sample = watch.look()
        account.descriptors = sample.front_files if sample is not None else 0
        await _ended(probing, account)
        for task in idling:
            task.cancel()
        await asyncio.gather(*idling, return_exceptions=True)
    async with http() as newcomer:
        await _ask_meanwhile(newcomer, server, 0.0, account, book)


async def _ask_meanwhile(
    client: httpx2.AsyncClient, server: Server, seconds: float, account: _Account, book: Book
) -> None:
    """Send good requests one after the other, at least one."""
    end = time.monotonic() + seconds
    while True:
        asked = ask(2_000)
        reply = await post(client, server.url, asked, _GOOD_S)
        account.good.append(reply.seconds)
        if reply.status != 200 or not book.check(asked, reply.body):
            account.bad.append(f"{asked.name}: {reply.status} {reply.code}")
        if time.monotonic() >= end:
            return
        await asyncio.sleep(_BREATH_S)


async def _ended(probing: "asyncio.Task[None]", account: _Account) -> None:
    """End the probes; one that failed is a bad answer."""
    probing.cancel()
    (error,) = await asyncio.gather(probing, return_exceptions=True)
    if not isinstance(error, asyncio.CancelledError):
        account.bad.append(f"probe: {error!r}")


async def _submitted(client: httpx2.AsyncClient, url: str, asked: Ask) -> str:
    answer = await client.post(f"{url}/jobs", params=asked.query, content=asked.body)
    assert answer.status_code == 202, answer.text
    return f"/jobs/{answer.json()['id']}"


def _keyed(token: str) -> httpx2.AsyncClient:
    client = http()
    client.headers["Authorization"] = f"Bearer {token}"
    return client


def _address(server: Server) -> hostile.Address:
    parts = urlsplit(server.url)
    return str(parts.hostname), int(parts.port or 80)


def _processor_s(server: Server) -> float:
    return sum(sum(worker.cpu_times()[:2]) for worker in server.workers())


def _log(server: Server) -> list[str]:
    return server.log.read_text("utf-8", "replace").splitlines()


def _warnings(server: Server) -> int:
    return sum('"level": "warning"' in line or '"level": "error"' in line for line in _log(server))


def _errors(server: Server) -> int:
    return sum('"level": "error"' in line or "Traceback (" in line for line in _log(server))


def _report(options: argparse.Namespace, account: _Account, book: Book) -> int:
    held = account.streams["200"]
    refused = {status: n for status, n in account.streams.items() if status not in ("200", "429")}
    busy = account.connections["503 too_many_connections"]
    lines = _LINES + int(options.seconds // 60) + 1
    other = {status: n for status, n in account.columns.items() if status not in _TOO_LARGE}
    slowest = max((*account.stream_probes, *account.connection_probes), default=float("inf"))
    claims = [
        Claim(
            f"one key holds at most {_STREAMS // 2} event streams, the rest is 429; another key "
            "gets one",
            f"{dict(account.streams)}, another key {account.other_key}",
            0 < held <= _STREAMS // 2 and not refused and account.other_key == 200,
        ),
        Claim(
            f"connections beyond {_CONNECTIONS} get 503 too_many_connections, and the log has at "
            f"most {lines} lines about it",
            f"{busy:,} times, {account.lines} lines",
            busy > 0 and account.lines <= lines,
        ),
        Claim(
            f"a small file of {_COLUMNS:,} columns at R={_RATIO:g} is a 413 before the work: it "
            f"takes less than {_WORK_S:g} s of the processor",
            f"{dict(account.columns)}, {account.columns_work_s:.2f} s each",
            bool(account.columns) and not other and account.columns_work_s < _WORK_S,
        ),
        Claim(
            "good requests are served meanwhile, and right",
            f"{len(account.good) - len(account.bad)} of {len(account.good)} {account.bad[:3]} "
            f"{book.wrong[:3]}",
            bool(account.good) and not account.bad and not book.wrong,
        ),
        Claim(
            f"/health/live is answered within {_PROBE_S:g} s meanwhile",
            f"slowest {slowest:.2f} s",
            slowest <= _PROBE_S,
        ),
        Claim("no 500", f"{account.internal:g}", not account.internal),
    ]
    figures = [
        ("streams, connections", f"{options.streams}, {options.connections}"),
        ("probes beside streams: median, p99, worst", spread(account.stream_probes, "ms")),
        ("probes beside connections: median, p99, worst", spread(account.connection_probes, "ms")),
        ("good requests: median, p99, worst", spread(account.good, "s")),
        ("columns refused: median, p99, worst", spread(account.columns_s, "s")),
        ("idle connections, as they ended", str(dict(account.connections))),
        ("descriptors of the front in the flood", str(account.descriptors)),
    ]
    raw = {
        "arguments": {k: v for k, v in vars(options).items() if k != "out"},
        "bad": account.bad[:100],
    }
    return verdict("floods", options.out, claims, figures, raw, os.sched_getaffinity(0))
