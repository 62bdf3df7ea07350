# SPDX-License-Identifier: Apache-2.0
"""HTTP as nobody should speak it, and every route beyond its description."""

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from benchmarks.reliability import hostile
from benchmarks.reliability.clouds import Book, ask
from benchmarks.reliability.processes import Sample, Watch
from benchmarks.reliability.service import Server, http, internal_errors, post, probe, served
from benchmarks.reliability.verdict import Claim, spread, verdict

__all__ = ["arguments", "faults_in", "main"]

_IDLE_S = 5  # what the service is told to wait for silent clients; 30 s would only cost time
_BODY_BYTES = 4 << 20
_GROWTH_BYTES = 64 << 20
_GOOD_S = 600.0
_BREATH_S = 0.1
_WARM_S = 5.0
_LONGEST_S = 60.0  # that the service bears with anybody, with room for a busy machine
# Its data are seldom clouds, and no schema says what makes a binary file one. And a job that was
# deleted is still told of, as cancelled or expired.
_EXCLUDED = "positive_data_acceptance,use_after_free"
# A job is accepted with its bytes unread: what is wrong with them shows when it runs.
_CONFIG = """
[[operations]]
include-operation-id = "submit_job"
[operations.checks]
negative_data_rejection.enabled = false
"""


@dataclass
class _Siege:
    """Events while the service was under attack."""

    statuses: Counter[str] = field(default_factory=Counter)
    held: dict[str, list[float]] = field(default_factory=dict)
    good: list[float] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    probes: list[float] = field(default_factory=list)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--seconds", type=float, default=120.0, help="of hostile sockets [120]")
    parser.add_argument("--attackers", type=int, default=16, help="at the same time [16]")
    parser.add_argument("--held", type=int, default=200, help="connections kept open [200]")
    parser.add_argument("--examples", type=int, default=300, help="per route and phase [300]")
    parser.add_argument("--seed", type=int, default=1)


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    limits = ["--max-body-bytes", str(_BODY_BYTES), "--workers", "2"]
    with served(*limits, PUGEO_BODY_IDLE_S=str(_IDLE_S)) as server:
        book = Book()
        # Wakes what is loaded when first used, so that memory has its size.
        asyncio.run(_besiege(server, options, _WARM_S, _Siege(), book))
        workers = {worker.pid for worker in server.workers()}
        described = _schemathesis(server, options)
        watch = Watch(server.process.pid)
        before = watch.look()
        siege = _Siege()
        asyncio.run(_besiege(server, options, options.seconds, siege, book))
        time.sleep(2 * _IDLE_S)
        after = watch.look()
        same = workers == {worker.pid for worker in server.workers()}
        log = server.log.read_text("utf-8", "replace").splitlines()
        errors = [line for line in log if '"level": "error"' in line or "Traceback (" in line]
        broken = internal_errors(server)
        alive = server.process.poll() is None
    return _report(
        options, siege, book, described, (before, after), (errors, broken, same and alive)
    )


async def _besiege(
    server: Server, options: argparse.Namespace, seconds: float, siege: _Siege, book: Book
) -> None:
    parts = urlsplit(server.url)
    address: hostile.Address = (str(parts.hostname), int(parts.port or 80))
    end = time.monotonic() + seconds

    async def attack(number: int) -> None:
        rng = random.Random(f"{options.seed}:{number}")
        while time.monotonic() < end:
            kind = rng.choice(hostile.QUICK)
            for status in await _survived(kind, address, rng) or ("no answer",):
                siege.statuses[status] += 1
            # The attackers share the processor with the attacked; here they are to be many, not
            # fast.
            await asyncio.sleep(_BREATH_S)

    async def hold(number: int) -> None:
        rng = random.Random(f"{options.seed}:held:{number}")
        kind = hostile.HOLDING[number % len(hostile.HOLDING)]
        while time.monotonic() < end:
            began = time.monotonic()
            for status in await _survived(kind, address, rng):
                siege.statuses[status] += 1
            siege.held.setdefault(kind.__name__, []).append(time.monotonic() - began)

    async with http() as client:
        probing = asyncio.create_task(probe(client, server.url, siege.probes))
        holding = [asyncio.create_task(hold(number)) for number in range(options.held)]
        attacking = [asyncio.create_task(attack(number)) for number in range(options.attackers)]
        rng = random.Random(options.seed)
        while time.monotonic() < end:
            asked = ask(rng.choice((500, 2000)))
            reply = await post(client, server.url, asked, _GOOD_S)
            siege.good.append(reply.seconds)
            if reply.status != 200 or not book.check(asked, reply.body):
                siege.bad.append(f"{asked.name}: {reply.status} {reply.code}")
        await asyncio.gather(*attacking)
        probing.cancel()
        # Those that the service never ended are counted with the time that they had.
        await asyncio.wait(holding, timeout=_LONGEST_S)
        for task in holding:
            if not task.done():
                siege.held.setdefault("never ended", []).append(seconds)
                task.cancel()
        await asyncio.gather(*holding, return_exceptions=True)


async def _survived(
    kind: Callable[[hostile.Address, random.Random], Awaitable[tuple[str, ...]]],
    address: hostile.Address,
    rng: random.Random,
) -> tuple[str, ...]:
    try:
        return await kind(address, rng)
    except OSError:
        return ()


def faults_in(statuses: Mapping[str, int]) -> int:
    """Return how many answers tell of a fault of the service, by status and code.

    A transfer coding that the service does not have is a 501, and a connection beyond the bound a
    503: both refuse what the client did.
    """
    return sum(
        number
        for status, number in statuses.items()
        if status.startswith("5")
        and status.partition(" ")[0] != "501"
        and status != "503 too_many_connections"
    )


def _schemathesis(server: Server, options: argparse.Namespace) -> dict[str, Any]:
    """Test every route with what its description allows and with what it does not."""
    if not options.examples:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        (Path(folder) / "schemathesis.toml").write_text(_CONFIG, "utf-8")
        command = [str(Path(sys.executable).with_name("schemathesis")), "run"]
        command += [f"{server.url}/openapi.json", "--max-examples", str(options.examples)]
        command += ["--seed", str(options.seed), "--exclude-checks", _EXCLUDED, "--no-shrink"]
        command += ["--continue-on-failure", "--request-timeout", "60", "--report", "json"]
        command += ["--report-json-path", str(report)]
        done = subprocess.run(
            command, check=False, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        if not report.exists():
            raise RuntimeError(done.stdout.decode("utf-8", "replace")[-4000:])
        found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    if found["failures"] or found["errors"]:
        sys.stderr.write(done.stdout.decode("utf-8", "replace")[-20_000:])
    return found


def _report(
    options: argparse.Namespace,
    siege: _Siege,
    book: Book,
    described: dict[str, Any],
    memory: tuple[Sample | None, Sample | None],
    health: tuple[list[str], float, bool],
) -> int:
    errors, broken, alive = health
    before, after = memory
    assert before is not None
    grown = after.rss - before.rss if after is not None else 1 << 40
    files = after.front_files - before.front_files if after is not None else 1 << 20
    internal = faults_in(siege.statuses)
    cases = described.get("test_cases", {})
    claims = [
        Claim(
            "no status of 500 or above to any of it, but for 501 and 503 too_many_connections; "
            "nothing at level error in the log",
            f"{internal} on sockets, {broken:g} counted, {len(errors)} lines",
            not (internal or broken or errors),
        ),
        Claim("the front and its workers live on", "the same processes" if alive else "no", alive),
        Claim(
            "good requests are served meanwhile, and right",
            f"{len(siege.good) - len(siege.bad)} of {len(siege.good)}, "
            f"slowest {max(siege.good, default=0.0):.1f} s",
            bool(siege.good) and not siege.bad and not book.wrong,
        ),
        Claim(
            "every connection that only sits there is ended, though it sends a byte at times",
            f"{len(siege.held.get('never ended', []))} of {options.held} never were",
            "never ended" not in siege.held,
        ),
        Claim(
            f"memory grows by less than {_GROWTH_BYTES >> 20} MiB, no descriptor is left open",
            f"{grown / 2**20:+.0f} MiB, {files:+d} descriptors",
            grown < _GROWTH_BYTES and files <= 5,
        ),
    ]
    if described:
        claims.append(
            Claim(
                "each route answers as its OpenAPI description says, to valid and invalid requests",
                f"{cases['generated']:,} cases of schemathesis on "
                f"{described['operations']['tested']} operations, "
                f"{len(described['failures'])} failures, {len(described['errors'])} errors",
                not described["failures"] and not described["errors"] and cases["generated"] > 0,
            )
        )
    figures = [
        ("attackers, held connections", f"{options.attackers}, {options.held}"),
        (
            "answers",
            ", ".join(f"{n:,} times {status}" for status, n in sorted(siege.statuses.items())),
        ),
        *(
            (f"held: {kind.replace('_', ' ')}", f"{len(s)} times, {max(s):.1f} s at most")
            for kind, s in sorted(siege.held.items())
        ),
        ("/health/live meanwhile: median, p99, worst", spread(siege.probes, "ms")),
    ]
    raw = {
        "arguments": {k: v for k, v in vars(options).items() if k != "out"},
        "bad": siege.bad[:100],
        "errors": errors[:100],
        "schemathesis": {k: described.get(k) for k in ("test_cases", "failures", "errors")},
    }
    return verdict("http", options.out, claims, figures, raw, os.sched_getaffinity(0))
