# SPDX-License-Identifier: Apache-2.0
"""What both kinds of jobs share: what was told of them, when to ask again, and the requests."""

import os
import secrets
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pugeo_client import _retry, _wire
from pugeo_client._attempts import Progress
from pugeo_client._sink import Sink
from pugeo_client._wire import Request
from pugeo_client.errors import DeadlineExceededError, PugeoError, SourceError, problem_error

__all__ = ["Told", "Watch", "job_request", "list_request", "submission"]

FIRST_POLL = 0.1  # seconds: a small cloud is done by then
LONGEST_POLL = 2.0
PATIENCE = 300.0
"""Seconds that a service may be gone, say for a restart, while somebody waits for a job."""
_FINAL = frozenset({"succeeded", "failed", "cancelled", "expired"})
_ABSENT = {"cancelled": "job_cancelled", "expired": "result_gone"}


class Told:
    """What the service last said about a job.

    Attributes:
        told: all of it, as JSON.
    """

    def __init__(self, told: Mapping[str, Any]) -> None:
        self.told = dict(told)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id} {self.state}>"

    @property
    def id(self) -> str:
        """Its id; keep it to find the job again with `Client.job`."""
        return str(self.told["id"])

    @property
    def state(self) -> str:
        """``queued``, ``running``, ``succeeded``, ``failed``, ``cancelled`` or ``expired``."""
        return str(self.told["state"])

    @property
    def finished(self) -> bool:
        """Whether its state is one of the last four."""
        return self.state in _FINAL

    @property
    def progress(self) -> tuple[str, int, int]:
        """Stage, patches done and patches in all (0: not known yet)."""
        progress = self.told["progress"]
        return progress["stage"], progress["done"], progress["total"] or 0

    @property
    def report(self) -> dict[str, Any] | None:
        """What was done (``points_in``, ``points_out``, ``dropped``, ``notes``), once it was."""
        report: dict[str, Any] | None = self.told["report"]
        return report

    def check(self) -> None:
        """Raise `error`, if there is one."""
        if self.error is not None:
            raise self.error

    @property
    def error(self) -> PugeoError | None:
        """Why there is no result and will be none, as the exception that `wait` raises."""
        if self.told["problem"] is not None:
            return problem_error(self.told["problem"])
        if self.state in _ABSENT:
            code, detail = _ABSENT[self.state], f"job {self.id} is {self.state}"
            return problem_error({"status": 410, "code": code, "detail": detail})
        return None

    def sink(self, out: str | os.PathLike[str] | None) -> Sink:
        """Where its result goes; raises SourceError for a file of another format."""
        written = str(self.told["options"]["format"])
        target = None if out is None else Path(out)
        if target is not None and _wire.default_format(target) != written.partition("-")[0]:
            raise SourceError(
                f"the job's result is {written}, not {target.suffix}; say format= when you submit, "
                "or save() what result() gives"
            )
        return Sink(format=written, out=target)

    def request(self, method: str, path: str = "") -> Request:
        """Build a request about it."""
        headers = {"Accept-Encoding": "identity"}
        return Request(method, f"/jobs/{self.id}{path}", headers=headers)


class Watch:
    """When to ask again while somebody waits for a job.

    Args:
        timeout: seconds to wait in all, or None.
        on_progress: told of every change, or None.
    """

    def __init__(self, timeout: float | None, on_progress: Progress | None) -> None:
        self._timeout = timeout
        self._end = float("inf") if timeout is None else time.monotonic() + timeout
        self._on_progress = on_progress
        self._shown: tuple[str, int, int] | None = None
        self._delay = FIRST_POLL
        self._lost: float | None = None

    @property
    def remaining(self) -> float:
        """Seconds left."""
        return self._end - time.monotonic()

    def within(self, longest: float) -> float:
        """Seconds that one question may take, ``longest`` at most."""
        return min(longest, max(self.remaining, 0.0))

    def seen(self, job: Told) -> None:
        """Take note of an answer."""
        self._lost = None
        if self._on_progress is not None and job.progress != self._shown:
            self._shown = job.progress
            self._on_progress(*job.progress)

    def missed(self, failure: PugeoError) -> None:
        """Take note of a question without an answer; raise what will not pass."""
        now = time.monotonic()
        self._lost = now if self._lost is None else self._lost
        late = isinstance(failure, DeadlineExceededError) and self.remaining > 0
        if not (late or _retry.may_succeed_later(failure)) or now - self._lost > PATIENCE:
            raise failure

    def pause(self) -> float:
        """Seconds until the next question; raises DeadlineExceededError where the time is up."""
        if self.remaining <= 0:
            raise DeadlineExceededError(f"the job did not end within {self._timeout:g} s")
        delay, self._delay = self._delay, min(self._delay * 1.5, LONGEST_POLL)
        return min(delay, max(self.remaining, 0.0))


def submission(upsample: Request, key: str | None) -> Request:
    """Turn the request of an upsampling into that of a job.

    Args:
        upsample: as `_wire.upsample_request` makes it.
        key: names the job for the service, so that sending it again makes no second one; by
            default a new one, which covers the tries of one call.
    """
    headers = {**upsample.headers, "Idempotency-Key": key or secrets.token_hex(16)}
    return replace(upsample, path="/jobs", headers=headers, awaited=False)


def job_request(job_id: str) -> Request:
    """Build the question about one job."""
    return Request("GET", f"/jobs/{job_id}")


def list_request(state: str | None, cursor: str | None) -> Request:
    """Build the question for a page of jobs."""
    params = {"limit": "100"}
    params |= {} if state is None else {"state": state}
    params |= {} if cursor is None else {"cursor": cursor}
    return Request("GET", "/jobs", params=params)
