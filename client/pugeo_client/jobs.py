# SPDX-License-Identifier: Apache-2.0
"""Jobs: upsampling that goes on without a connection and across restarts of the service."""

import asyncio
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from pugeo_client import _blocking_io
from pugeo_client._aconnection import AsyncConnection
from pugeo_client._attempts import Progress
from pugeo_client._connection import Connection
from pugeo_client._job_record import JobRecord, PollSchedule, checked_record
from pugeo_client._result import Result
from pugeo_client.errors import PugeoError

__all__ = ["AsyncJob", "Job"]


class Job(JobRecord):
    """A job of a `Client`.

    Example:
        >>> job = client.submit("scan.ply", ratio=8)  # doctest: +SKIP
        >>> job.result().save("dense.ply")  # doctest: +SKIP
    """

    def __init__(self, connection: Connection, record: Mapping[str, Any]) -> None:
        super().__init__(record)
        self._connection = connection

    def refresh(self, *, timeout: float | None = None) -> Self:
        """Ask the service for the present state; return itself."""
        self.record = self._connection.document(
            self.request("GET"), checked_record, timeout=timeout
        )
        return self

    def wait(self, timeout: float | None = None, on_progress: Progress | None = None) -> Self:
        """Wait until the job has succeeded; the service may be restarted meanwhile.

        Args:
            timeout: seconds; None waits without a limit.
            on_progress: called with a stage, patches done, patches in total (0: unknown).

        Raises:
            StatusError: it failed (the error that `Client.upsample` would have raised), or was
                cancelled or deleted (``GoneError``).
            DeadlineExceededError: it did not end within ``timeout``; it goes on.
            ConnectionFailedError: the service was unreachable for minutes.
        """
        schedule = PollSchedule(timeout, on_progress)
        while True:
            try:
                self.record = self._connection.document(
                    self.request("GET"),
                    checked_record,
                    timeout=schedule.request_timeout(self._connection.timeout),
                    max_retries=0,
                )
            except PugeoError as failure:
                schedule.tolerate(failure)
            else:
                schedule.report(self)
                if self.finished:
                    self.check()
                    return self
            _blocking_io.wait(schedule.pause())

    def result(
        self,
        out: str | os.PathLike[str] | None = None,
        *,
        timeout: float | None = None,
        on_progress: Progress | None = None,
    ) -> Result:
        """Wait until the job has succeeded, and download the dense cloud.

        Args:
            out: output file; it is written atomically.
            timeout: seconds to wait for the job, as in `wait`, and again for the download.
            on_progress: as in `wait`, and then with ``"receive"``, bytes done, bytes in total.

        Raises:
            SourceError: ``out`` has the extension of another format than the result.
            PugeoError: as `wait`.
        """
        receiver = self.receiver(None if out is None else Path(out))
        self.wait(timeout, on_progress)
        return self._connection.call(
            self.request("GET", "/result"), receiver, timeout=timeout, on_progress=on_progress
        )

    def cancel(self, *, timeout: float | None = None) -> Self:
        """Cancel the job, or delete its result if it has ended. Idempotent."""
        self.record = self._connection.document(
            self.request("DELETE"), checked_record, timeout=timeout
        )
        return self


class AsyncJob(JobRecord):
    """A job of an `AsyncClient`: the same as `Job`, awaited."""

    def __init__(self, connection: AsyncConnection, record: Mapping[str, Any]) -> None:
        super().__init__(record)
        self._connection = connection

    async def refresh(self, *, timeout: float | None = None) -> Self:  # noqa: ASYNC109
        """Ask the service for the present state; return itself."""
        self.record = await self._connection.document(
            self.request("GET"), checked_record, timeout=timeout
        )
        return self

    async def wait(
        self,
        timeout: float | None = None,  # noqa: ASYNC109 - spans many requests
        on_progress: Progress | None = None,
    ) -> Self:
        """Wait until the job has succeeded; as `Job.wait`."""
        schedule = PollSchedule(timeout, on_progress)
        while True:
            try:
                self.record = await self._connection.document(
                    self.request("GET"),
                    checked_record,
                    timeout=schedule.request_timeout(self._connection.timeout),
                    max_retries=0,
                )
            except PugeoError as failure:
                schedule.tolerate(failure)
            else:
                schedule.report(self)
                if self.finished:
                    self.check()
                    return self
            await asyncio.sleep(schedule.pause())

    async def result(
        self,
        out: str | os.PathLike[str] | None = None,
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - as in `wait`
        on_progress: Progress | None = None,
    ) -> Result:
        """Wait until the job has succeeded, and download the dense cloud; as `Job.result`."""
        receiver = self.receiver(None if out is None else Path(out))
        await self.wait(timeout, on_progress)
        return await self._connection.call(
            self.request("GET", "/result"), receiver, timeout=timeout, on_progress=on_progress
        )

    async def cancel(self, *, timeout: float | None = None) -> Self:  # noqa: ASYNC109
        """Cancel the job; as `Job.cancel`."""
        self.record = await self._connection.document(
            self.request("DELETE"), checked_record, timeout=timeout
        )
        return self
