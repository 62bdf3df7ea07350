# SPDX-License-Identifier: Apache-2.0
"""Three worker hosts, a scheduler and two fronts in namespaces, over TLS, and what goes wrong."""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.reliability.clouds import Book, ask
from benchmarks.reliability.lab import Host, lab, missing
from benchmarks.reliability.service import http
from benchmarks.reliability.verdict import Claim, verdict

__all__ = ["arguments", "main"]

_HOSTS = ["scheduler", "worker1", "worker2", "worker3", "front1", "front2"]
_CERTIFICATES = Path(__file__).parents[2] / "deploy" / "make_certs.py"
_WAIT_S = 1800.0
_NOT_READY_S = 2.0
_AWAY_S = 8.0  # longer than fronts need to notice
_PROBE_S = 0.05
_PEM = ("ca", "cert", "key")


@dataclass
class _Account:
    """Figures of a run.

    Attributes:
        seconds: label and duration.
        not_ready_s: fault and front, and the seconds until it said that it is not ready.
        jobs: name of each job, and its last state.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    not_ready_s: dict[str, float] = field(default_factory=dict)
    jobs: dict[str, dict[str, Any]] = field(default_factory=dict)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be chosen."""
    parser.add_argument("--points", type=int, default=1_000_000, help="of the cloud [1000000]")
    parser.add_argument("--ratio", type=float, default=4.0, help="points out for each in [4]")
    parser.add_argument("--model", default="fast", help="weights [fast]")
    parser.add_argument("--keep", type=Path, help="folder for logs, kept")
    parser.add_argument("--database", help="postgresql://... that the fronts reach [SQLite]")
    parser.add_argument("--store", help="URL of the store of jobs [the shared disk]")


def main(options: argparse.Namespace) -> int:
    """Run it; return the exit status."""
    if lack := missing():
        sys.stdout.write(f"skipped: {lack}\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="pugeo-") as folder:
        logs = options.keep or Path(folder)
        logs.mkdir(parents=True, exist_ok=True)
        with lab(logs, _HOSTS) as hosts:
            return asyncio.run(_Machines(options, hosts, Path(folder)).run())


class _Machines:
    def __init__(self, options: argparse.Namespace, hosts: dict[str, Host], folder: Path) -> None:
        self._options = options
        self._hosts = hosts
        self._folder = folder
        self._book = Book()
        self._account = _Account()
        self._asked = ask(options.points, options.ratio)
        self._small = ask(2_000, 2.0)
        self._client: httpx2.AsyncClient = http()
        self._began = time.monotonic()
        certificates = folder / "certificates"
        subprocess.run([sys.executable, _CERTIFICATES, certificates], check=True)
        spool = folder / "spool"
        spool.mkdir()
        self._environment = {
            **{f"PUGEO_TLS_{n.upper()}": str(certificates / f"{n}.pem") for n in _PEM},
            "PUGEO_MODEL": options.model,
            "PUGEO_SPOOL_DIR": str(spool),
            "PUGEO_JOBS_DEADLINE_S": "7200",
            "PUGEO_DEADLINE_S": "7200",
            "PUGEO_HOST": "0.0.0.0",  # noqa: S104 - within its namespace
        }
        self._scheduler = f"tls://{hosts['scheduler'].address}:8786"

    async def run(self) -> int:
        """Run all parts in order."""
        async with self._client:
            await self._start()
            await self._undisturbed()
            await self._cut_and_join()
            await self._scheduler_cut()
            await self._scheduler_killed_and_front_killed()
            listed = await self._listed()
            statuses = {name: self._hosts[name].stop() for name in reversed(_HOSTS)}
        return self._report(listed, statuses)

    async def _start(self) -> None:
        began = time.monotonic()
        self._start_scheduler()
        for name in ("worker1", "worker2"):
            self._start_worker(name)
        for name in ("front1", "front2"):
            self._start_front(name)
        await self._until_workers(2)
        self._note("from nothing to two fronts with two workers", began)

    async def _undisturbed(self) -> None:
        """Upsample the cloud by a plain request; its bytes are what all jobs must give."""
        began = time.monotonic()
        url = f"{self._url('front1')}/upsample"
        answer = await self._client.post(url, params=self._asked.query, content=self._asked.body)
        assert answer.status_code == 200, answer.text[:500]
        assert self._book.check(self._asked, answer.content), self._book.wrong
        self._note("undisturbed, two workers", began)

    async def _cut_and_join(self) -> None:
        """Cut a host off amid a job, let another one join, and bring the first one back."""
        job = await self._submit("front1", "cut")
        await self._until_middle("front1", job)
        began = time.monotonic()
        self._hosts["worker2"].cut()
        self._tell("worker2 is cut off; worker3 joins")
        self._start_worker("worker3")
        await self._until(lambda: self._workers("front2", 1), "the cut host is noticed")
        self._note("until a front no longer counts the cut host", began)
        await self._until_workers(2)
        self._note("until the new host works", began)
        await self._finish("front1", job, "cut")
        self._note("job with a host cut off, from the cut", began)
        began = time.monotonic()
        self._hosts["worker2"].mend()
        await self._until_workers(3)
        self._note("from the link up again until the cut host works", began)

    async def _scheduler_cut(self) -> None:
        """Cut the scheduler off for some seconds."""
        began = time.monotonic()
        self._hosts["scheduler"].cut()
        await self._both_not_ready("scheduler cut off", began)
        await asyncio.sleep(_AWAY_S)
        began = time.monotonic()
        self._hosts["scheduler"].mend()
        await self._until_workers(3)
        self._note("from the scheduler's link up again until all work", began)

    async def _scheduler_killed_and_front_killed(self) -> None:
        """Kill the scheduler amid a job, and later the front that runs the job."""
        job = await self._submit("front1", "lost")
        await self._until_middle("front1", job)
        began = time.monotonic()
        self._hosts["scheduler"].kill()
        self._tell("the scheduler is killed")
        await self._both_not_ready("scheduler killed", began)
        await asyncio.sleep(_AWAY_S)
        began = time.monotonic()
        self._start_scheduler()
        await self._until_workers(3)
        self._note("from the scheduler's restart until all work", began)
        await self._until_middle("front1", job)
        self._note("until the job is in its middle again", began)
        runner = await self._runner(job)
        began = time.monotonic()
        self._hosts[runner].kill()
        other = "front2" if runner == "front1" else "front1"
        self._tell(f"{runner}, which runs the job, is killed")
        attempts = self._account.jobs["lost"]["attempts"]
        await self._until(lambda: self._taken_over(other, job, attempts), "the job is taken over")
        self._note("from the death of a front until the other runs its job", began)
        await self._finish(other, job, "lost")
        self._note("job that lost scheduler and front, from the front's death", began)
        began = time.monotonic()
        self._start_front(runner)
        await self._until_workers(3)
        self._note("until the killed front serves again", began)

    def _start_scheduler(self) -> None:
        host = self._hosts["scheduler"]
        host.start("scheduler", "--host", host.address, **self._environment)

    def _start_worker(self, name: str) -> None:
        environment = {**self._environment, "PUGEO_SCHEDULER": self._scheduler}
        self._hosts[name].start("worker", "--workers", "1", **environment)

    def _start_front(self, name: str) -> None:
        environment = {
            **self._environment,
            "PUGEO_SCHEDULER": self._scheduler,
            # Of its own, so that only the row tells which front runs a job.
            "PUGEO_JOBS_RUNNING": "1",
        }
        shared = self._folder / "jobs"
        environment["PUGEO_JOBS_DIR"] = str(shared / name if self._options.store else shared)
        if self._options.store:
            environment["PUGEO_JOBS_STORE"] = self._options.store
        if self._options.database:
            environment["PUGEO_DATABASE_URL"] = self._options.database
        self._hosts[name].start("serve", "--port", "8000", **environment)

    async def _submit(self, front: str, name: str) -> str:
        answer = await self._client.post(
            f"{self._url(front)}/jobs",
            params=self._asked.query,
            content=self._asked.body,
            headers={"Idempotency-Key": name},
        )
        assert answer.status_code in (200, 202), answer.text
        job_id: str = answer.json()["id"]
        return job_id

    async def _until_middle(self, front: str, job: str) -> None:
        """Wait until a third of the patches of a job are done."""

        async def check() -> bool:
            told = (await self._client.get(f"{self._url(front)}/jobs/{job}")).json()
            done, total = told["progress"]["done"], told["progress"]["total"]
            assert told["state"] in ("queued", "running"), told
            return bool(total) and done > total / 3

        await self._until(check, f"job {job} is in its middle")

    async def _finish(self, front: str, job: str, name: str) -> None:
        """Follow a job to its end; check its bytes, and that it was run under one key once."""

        async def check() -> bool:
            answer = await self._client.get(f"{self._url(front)}/jobs/{job}")
            self._account.jobs[name] = answer.json()
            return self._account.jobs[name]["state"] not in ("queued", "running")

        await self._until(check, f"job {name} has ended")
        told = self._account.jobs[name]
        if told["state"] != "succeeded":
            self._book.wrong.append(f"job {name}: {json.dumps(told)[:500]}")
            return
        for each in self._alive():
            answer = await self._client.get(f"{self._url(each)}/jobs/{job}/result")
            if answer.status_code != 200:
                self._book.wrong.append(f"result of {name} at {each}: {answer.status_code}")
            else:
                self._book.check(self._asked, answer.content)
        again = await self._submit(front, name)
        if again != job:
            self._book.wrong.append(f"key {name} led to a second job")

    async def _taken_over(self, front: str, job: str, attempts: int) -> bool:
        answer = await self._client.get(f"{self._url(front)}/jobs/{job}")
        told = answer.json()
        return told["state"] in ("running", "succeeded") and told["attempts"] > attempts

    async def _runner(self, job: str) -> str:
        """Return the front whose log says that it runs a job."""
        told = await self._client.get(f"{self._url('front2')}/jobs/{job}")
        self._account.jobs["lost"] = told.json()
        last: dict[str, str] = {}
        for name in ("front1", "front2"):
            for line in self._hosts[name].log.read_text("utf-8").splitlines():
                if line.startswith("{") and '"job started"' in line and job in line:
                    last[name] = json.loads(line)["timestamp"]
        return max(last, key=lambda name: last[name])

    async def _both_not_ready(self, fault: str, began: float) -> None:
        async def one(front: str) -> None:
            await self._until(lambda: self._ready(front, 503), f"{front} is not ready")
            self._account.not_ready_s[f"{fault}, {front}"] = time.monotonic() - began

        await asyncio.gather(one("front1"), one("front2"))

    async def _until_workers(self, count: int) -> None:
        """Wait until both fronts are ready with so many workers and answer a small request."""
        for front in self._alive():
            await self._until(partial(self._workers, front, count), f"{front} has {count} workers")
            await self._until(partial(self._serves, front), f"{front} serves")

    async def _workers(self, front: str, count: int) -> bool:
        answer = await self._client.get(f"{self._url(front)}/health", timeout=2)
        told = answer.json()
        return bool(told["status"] == "ready" and told["workers"] == count)

    async def _ready(self, front: str, status: int) -> bool:
        answer = await self._client.get(f"{self._url(front)}/health/ready", timeout=2)
        return answer.status_code == status

    async def _serves(self, front: str) -> bool:
        url = f"{self._url(front)}/upsample"
        answer = await self._client.post(url, params=self._small.query, content=self._small.body)
        return answer.status_code == 200 and self._book.check(self._small, answer.content)

    async def _listed(self) -> int:
        answer = await self._client.get(f"{self._url('front2')}/jobs")
        return len(answer.json()["jobs"])

    async def _until(self, check: Callable[[], Awaitable[bool]], what: str) -> None:
        end = time.monotonic() + _WAIT_S
        while time.monotonic() < end:
            try:
                if await check():
                    return
            except (httpx2.TransportError, KeyError, ValueError):
                pass
            await asyncio.sleep(_PROBE_S)
        raise RuntimeError(f"not within {_WAIT_S:g} s: {what}")

    def _alive(self) -> list[str]:
        return [name for name in ("front1", "front2") if self._hosts[name].runs]

    def _url(self, front: str) -> str:
        return f"http://{self._hosts[front].address}:8000"

    def _note(self, label: str, began: float) -> None:
        self._account.seconds[label] = time.monotonic() - began
        self._tell(f"{label}: {self._account.seconds[label]:.1f} s")

    def _tell(self, text: str) -> None:
        sys.stdout.write(f"{time.monotonic() - self._began:7.1f} s  {text}\n")
        sys.stdout.flush()

    def _report(self, listed: int, statuses: dict[str, int | None]) -> int:
        account, book = self._account, self._book
        states = ", ".join(f"{name}: {job['state']}" for name, job in account.jobs.items())
        slowest = max(account.not_ready_s.values())
        failed = {name: status for name, status in statuses.items() if status != 0}
        claims = [
            Claim(
                "each job succeeds, and gives the bytes of the undisturbed request",
                f"{states}; {book.right} answers right, {len(book.wrong)} wrong {book.wrong[:3]}",
                not book.wrong
                and all(job["state"] == "succeeded" for job in account.jobs.values()),
            ),
            Claim("nothing is done twice", f"{listed} jobs of 2 keys", listed == 2),
            Claim(
                f"without a scheduler each front says not ready within {_NOT_READY_S:g} s",
                f"slowest after {slowest:.2f} s",
                slowest <= _NOT_READY_S,
            ),
            Claim(
                "each process ends in order on SIGTERM",
                f"status 0 of {len(statuses) - len(failed)} of {len(statuses)} {failed or ''}",
                not failed,
            ),
        ]
        figures = [(label, f"{seconds:.1f} s") for label, seconds in account.seconds.items()]
        figures += [(f"not ready: {k}", f"{v:.2f} s") for k, v in account.not_ready_s.items()]
        attempts = {name: job["attempts"] for name, job in account.jobs.items()}
        figures.append(("attempts of the jobs", str(attempts)))
        raw = {"options": {k: str(v) for k, v in vars(self._options).items()}}
        cores = os.sched_getaffinity(0)
        return verdict("machines", self._options.out, claims, figures, raw, cores)
