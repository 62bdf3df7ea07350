# SPDX-License-Identifier: Apache-2.0
"""A full disk under the jobs, and room again. Needs Linux and root, for a small file system."""

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx2

from benchmarks.reliability.clouds import Ask, Book, ask
from benchmarks.reliability.service import Server, http, internal_errors, post, served
from benchmarks.reliability.verdict import Claim, verdict

__all__ = ["arguments", "fill", "main", "missing", "small_disk"]

_DISK_BYTES = 16 << 20
_PIECE_BYTES = 64 << 10
_WAIT_S = 600.0
_LOOK_S = 0.2
_FULL = (503, 507)


@dataclass
class _Account:
    """Answers in each part.

    Attributes:
        refused: answers to jobs while the disk was full, by status and code.
        without_wait: refusals that do not say when to come again.
        deleted: answers to deletions while the disk was full, by status.
        plain: statuses of requests without a job while the disk was full.
        accepted_s: seconds from the room's return until a job was accepted.
        states: of the jobs that were accepted after that.
    """

    refused: Counter[str] = field(default_factory=Counter)
    without_wait: int = 0
    deleted: Counter[str] = field(default_factory=Counter)
    plain: Counter[str] = field(default_factory=Counter)
    accepted_s: float = float("inf")
    states: Counter[str] = field(default_factory=Counter)


def missing() -> str | None:
    """Return what this machine lacks for a small file system, or ``None``."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "a small file system needs Linux and root"
    try:
        with small_disk(1 << 20):
            return None
    except (OSError, subprocess.CalledProcessError):
        return "this system lets nobody mount a file system"


@contextmanager
def small_disk(size: int) -> Iterator[Path]:
    """A file system of so many bytes, in memory."""
    with tempfile.TemporaryDirectory(prefix="pugeo-disk-") as folder:
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "pugeo-disk", folder]
        subprocess.run(mount, check=True, capture_output=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True, capture_output=True)


def fill(path: Path) -> int:
    """Write a file until its disk is full; return its bytes."""
    piece = bytes(_PIECE_BYTES)
    with path.open("ab", buffering=0) as file:
        while piece:
            try:
                written = file.write(piece)
            except OSError:
                written = 0
            # Pieces become smaller towards the end, so that no byte is left.
            if written < len(piece):
                piece = piece[: len(piece) // 2]
        return file.tell()


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--times", type=int, default=5, help="jobs in each part [5]")
    parser.add_argument("--rounds", type=int, default=3, help="full and back [3]")


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    if lack := missing():
        sys.stdout.write(f"skipped: {lack}\n")
        return 0
    account, book = _Account(), Book()
    slowest = 0.0
    with (
        small_disk(_DISK_BYTES) as folder,
        served("--workers", "1", PUGEO_JOBS_DIR=str(folder / "jobs")) as server,
    ):
        for _ in range(options.rounds):
            asyncio.run(_full_and_back(server, folder / "filler", options.times, account, book))
            slowest = max(slowest, account.accepted_s)
        internal = internal_errors(server)
        alive = server.process.poll() is None
    return _report(options, account, book, slowest, internal, alive)


async def _full_and_back(
    server: Server, filler: Path, times: int, account: _Account, book: Book
) -> None:
    asked = ask(2_000)
    async with http() as client:
        kept = [await _submitted(client, server.url, asked) for _ in range(times)]
        for job in kept:
            account.states[await _final(client, f"{server.url}/jobs/{job}")] += 1
        await asyncio.to_thread(fill, filler)
        for _ in range(times):
            answer = await _submit(client, server.url, asked)
            code = answer.json().get("code", "")
            account.refused[f"{answer.status_code} {code}".strip()] += 1
            account.without_wait += "retry-after" not in answer.headers
        reply = await post(client, server.url, asked, _WAIT_S)
        account.plain[f"{reply.status} {reply.code}".strip()] += 1
        if reply.status == 200:
            book.check(asked, reply.body)
        for job in kept:
            answer = await client.delete(f"{server.url}/jobs/{job}")
            account.deleted[str(answer.status_code)] += 1
        await asyncio.to_thread(filler.unlink)
        began = time.monotonic()
        job = await _submitted(client, server.url, asked)
        account.accepted_s = time.monotonic() - began
        account.states[await _final(client, f"{server.url}/jobs/{job}")] += 1
        await client.delete(f"{server.url}/jobs/{job}")


async def _submit(client: httpx2.AsyncClient, url: str, asked: Ask) -> httpx2.Response:
    return await client.post(f"{url}/jobs", params=asked.query, content=asked.body)


async def _submitted(client: httpx2.AsyncClient, url: str, asked: Ask) -> str:
    """Submit a job until it is accepted; return its id."""
    end = time.monotonic() + _WAIT_S
    while (answer := await _submit(client, url, asked)).status_code != 202:
        if time.monotonic() > end:
            raise RuntimeError(f"no job is accepted: {answer.status_code} {answer.text[:300]}")
        await asyncio.sleep(_LOOK_S)
    job: str = answer.json()["id"]
    return job


async def _final(client: httpx2.AsyncClient, url: str) -> str:
    """Wait for the end of a job; return its state."""
    end = time.monotonic() + _WAIT_S
    while time.monotonic() < end:
        state: str = (await client.get(url)).json()["state"]
        if state not in ("queued", "running"):
            return state
        await asyncio.sleep(_LOOK_S)
    return "never ended"


def _report(
    options: argparse.Namespace,
    account: _Account,
    book: Book,
    slowest: float,
    internal: float,
    alive: bool,
) -> int:
    refused, states = account.refused, account.states
    other = [status for status in refused if int(status[:3]) not in _FULL]
    claims = [
        Claim(
            "while the disk of the jobs is full, each job is refused with 503 or 507 and a time "
            "to come again",
            f"{dict(refused)}, {account.without_wait} without a time",
            bool(refused) and not other and not account.without_wait,
        ),
        Claim(
            "deletions work on the full disk",
            f"{dict(account.deleted)}",
            set(account.deleted) == {"200"},
        ),
        Claim(
            "requests without a job are served meanwhile, and right",
            f"{dict(account.plain)}, {len(book.wrong)} wrong",
            set(account.plain) == {"200"} and not book.wrong,
        ),
        Claim(
            "with room again jobs are accepted, and all accepted ones succeed",
            f"{dict(states)}",
            set(states) == {"succeeded"},
        ),
        Claim("no 500, and the service lives", f"{internal:g}", alive and not internal),
    ]
    figures = [
        ("rounds", str(options.rounds)),
        ("from the room's return until a job was accepted, at most", f"{slowest:.1f} s"),
    ]
    raw = {"arguments": {k: v for k, v in vars(options).items() if k != "out"}}
    return verdict("disk", options.out, claims, figures, raw, os.sched_getaffinity(0))
