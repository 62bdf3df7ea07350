# SPDX-License-Identifier: Apache-2.0
"""State of a job as the service reports it, and the schedule of asking for it."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pugeo_client import _retry
from pugeo_client._attempts import Progress
from pugeo_client._receivers import CloudReceiver
from pugeo_client._requests import EXTENSIONS, Request, format_of, job_request
from pugeo_client.errors import (
    DeadlineExceededError,
    InvalidResponseError,
    PugeoError,
    SourceError,
    problem_error,
)

__all__ = ["JobRecord", "PollSchedule", "checked_record", "next_cursor"]

FIRST_POLL = 0.1  # seconds: a small cloud is done by then
MAX_POLL = 2.0  # seconds
MAX_OUTAGE = 300.0
"""Seconds that the service may be unreachable, as in a restart, while `Job.wait` waits."""
_FINAL = frozenset({"succeeded", "failed", "cancelled", "expired"})
_WITHOUT_RESULT = {"cancelled": "job_cancelled", "expired": "result_gone"}


class JobRecord:
    """A job as the service last reported it.

    Attributes:
        record: the whole report, as JSON.
    """

    def __init__(self, record: Mapping[str, Any]) -> None:
        self.record = checked_record(record)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id} {self.state}>"

    @property
    def id(self) -> str:
        """Its id, for `Client.job`."""
        return str(self.record["id"])

    @property
    def state(self) -> str:
        """``queued``, ``running``, ``succeeded``, ``failed``, ``cancelled`` or ``expired``."""
        return str(self.record["state"])

    @property
    def finished(self) -> bool:
        """True if its state is one of the last four."""
        return self.state in _FINAL

    @property
    def progress(self) -> tuple[str, int, int]:
        """Stage, patches done and patches in total (0: not known yet)."""
        progress = self.record["progress"]
        return progress["stage"], progress["done"], progress["total"] or 0

    @property
    def report(self) -> dict[str, Any] | None:
        """After success: ``points_in``, ``points_out``, ``dropped``, ``notes``."""
        report: dict[str, Any] | None = self.record.get("report")
        return report

    def check(self) -> None:
        """Raise `error`, if there is one."""
        if self.error is not None:
            raise self.error

    @property
    def error(self) -> PugeoError | None:
        """Exception that `wait` raises for a job that will have no result, else None."""
        if self.record.get("problem") is not None:
            return problem_error(self.record["problem"])
        if self.state in _WITHOUT_RESULT:
            code, detail = _WITHOUT_RESULT[self.state], f"job {self.id} is {self.state}"
            return problem_error({"status": 410, "code": code, "detail": detail})
        return None

    def receiver(self, out: Path | None) -> CloudReceiver:
        """Return a receiver of the result.

        Raises:
            SourceError: ``out`` has the extension of another format than the result.
            OSError: ``out`` cannot be written.
        """
        written = str(self.record["options"]["format"])
        known = out is not None and out.suffix.lower() in EXTENSIONS
        if out is not None and known and format_of(out) != written.partition("-")[0]:
            raise SourceError(
                f"the result of the job is {written}, not {out.suffix}; say format= when you "
                "submit, or save() what result() returns"
            )
        return CloudReceiver(format=written, out=out)

    def request(self, method: str, path: str = "") -> Request:
        """Build a request about this job."""
        return job_request(method, self.id, path)


class PollSchedule:
    """Times of asking for the state of a job.

    Args:
        timeout: seconds to wait in total, or None for no limit.
        on_progress: called after each change, or None.
    """

    def __init__(self, timeout: float | None, on_progress: Progress | None) -> None:
        self._timeout = timeout
        self._end = float("inf") if timeout is None else time.monotonic() + timeout
        self._on_progress = on_progress
        self._reported: tuple[str, int, int] | None = None
        self._delay = FIRST_POLL
        self._outage_start: float | None = None

    @property
    def remaining(self) -> float:
        """Seconds left."""
        return self._end - time.monotonic()

    def request_timeout(self, limit: float) -> float:
        """Return the seconds that one request may take, ``limit`` at most."""
        return min(limit, max(self.remaining, 0.0))

    def report(self, job: JobRecord) -> None:
        """Register an answer, and report progress that has changed."""
        self._outage_start = None
        if self._on_progress is not None and job.progress != self._reported:
            self._reported = job.progress
            self._on_progress(*job.progress)

    def tolerate(self, failure: PugeoError) -> None:
        """Register a failed request; raise the failure if it is permanent or lasts too long."""
        now = time.monotonic()
        self._outage_start = now if self._outage_start is None else self._outage_start
        slow = isinstance(failure, DeadlineExceededError) and self.remaining > 0
        transient = slow or _retry.is_transient(failure)
        if not transient or now - self._outage_start > MAX_OUTAGE:
            raise failure

    def pause(self) -> float:
        """Return the seconds until the next request.

        Raises:
            DeadlineExceededError: there are none left.
        """
        if self.remaining <= 0:
            raise DeadlineExceededError(f"the job did not end within {self._timeout:g} s")
        delay, self._delay = self._delay, min(self._delay * 1.5, MAX_POLL)
        return min(delay, max(self.remaining, 0.0))


def checked_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the report of a job, if it has the members that this package reads.

    Raises:
        InvalidResponseError: one is missing or of another type.
    """
    progress, options = record.get("progress"), record.get("options")
    problem, report = record.get("problem"), record.get("report")
    valid = (
        isinstance(record.get("id"), str)
        and isinstance(record.get("state"), str)
        and isinstance(progress, dict)
        and isinstance(progress.get("stage"), str)
        and isinstance(progress.get("done"), int)
        and isinstance(progress.get("total"), (int, type(None)))
        and "total" in progress
        and isinstance(options, dict)
        and isinstance(options.get("format"), str)
        and isinstance(report, (dict, type(None)))
        and (problem is None or (isinstance(problem, dict) and _is_status(problem.get("status"))))
    )
    if not valid:
        raise InvalidResponseError("the answer does not describe a job")
    return dict(record)


def next_cursor(page: Mapping[str, Any], seen: set[str]) -> str | None:
    """Return the cursor of the page that follows, or None after the last one.

    Args:
        page: answer to a request for a page of jobs.
        seen: cursors of the pages before; the new one is added.

    Raises:
        InvalidResponseError: it is no page, or the pages would go on for ever: one is empty and
            not the last, or its cursor came before.
    """
    jobs, cursor = page.get("jobs"), page.get("next")
    objects = isinstance(jobs, list) and all(isinstance(job, dict) for job in jobs)
    if not objects or not isinstance(cursor, (str, type(None))):
        raise InvalidResponseError("the answer is no page of jobs")
    if cursor is None:
        return None
    if not jobs or cursor in seen:
        raise InvalidResponseError("the list of jobs does not end: its pages repeat")
    seen.add(cursor)
    return cursor


def _is_status(value: Any) -> bool:
    return isinstance(value, int) and 100 <= value <= 599
