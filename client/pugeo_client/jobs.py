# SPDX-License-Identifier: Apache-2.0
"""Jobs: clouds that the service makes denser while nobody waits on the line."""

import asyncio
import os
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

from pugeo_client._attempts import Progress
from pugeo_client._job import Told, Watch
from pugeo_client._result import Result
from pugeo_client.errors import PugeoError

if TYPE_CHECKING:
    from pugeo_client._aclient import AsyncClient
    from pugeo_client._client import Client

__all__ = ["AsyncJob", "Job"]


class Job(Told):
    """A job of a `Client`.

    Example:
        >>> job = client.submit("scan.ply", ratio=8)  # doctest: +SKIP
        >>> job.result().save("dense.ply")  # doctest: +SKIP
    """

    def __init__(self, client: "Client", told: Mapping[str, Any]) -> None:
        super().__init__(told)
        self._client = client

    def refresh(self, *, timeout: float | None = None) -> Self:
        """Ask the service how it is; returns itself."""
        self.told = self._client._json(self.request("GET"), timeout=timeout)  # noqa: SLF001
        return self

    def wait(self, timeout: float | None = None, on_progress: Progress | None = None) -> Self:
        """Wait until it has succeeded; the service may be restarted meanwhile.

        Args:
            timeout: seconds; None waits as long as it takes.
            on_progress: called with a stage, patches done, patches in all (0: unknown).

        Raises:
            StatusError: it failed (the error that `Client.upsample` would have raised), or was
                cancelled or deleted (``GoneError``).
            DeadlineExceededError: it did not end within ``timeout``; it goes on.
            ConnectionFailedError: the service was gone for minutes.
        """
        watch = Watch(timeout, on_progress)
        while True:
            try:
                told = self._client._json(  # noqa: SLF001
                    self.request("GET"), timeout=watch.within(self._client.timeout), max_retries=0
                )
            except PugeoError as failure:
                watch.missed(failure)
            else:
                self.told = told
                watch.seen(self)
                if self.finished:
                    self.check()
                    return self
            time.sleep(watch.pause())

    def result(
        self,
        out: str | os.PathLike[str] | None = None,
        *,
        timeout: float | None = None,
        on_progress: Progress | None = None,
    ) -> Result:
        """Wait until it has succeeded, and fetch the dense cloud.

        Args:
            out: file to stream it to; it appears when it is complete.
            timeout: seconds to wait for the job, as in `wait`, and again for the download.
            on_progress: as in `wait`, and then with ``"receive"``, bytes done, bytes in all.

        Raises:
            SourceError: ``out`` has the extension of another format than the job's.
            PugeoError: as `wait`.
        """
        sink = self.sink(out)
        self.wait(timeout, on_progress)
        return self._client._call(  # noqa: SLF001
            self.request("GET", "/result"), sink, timeout=timeout, on_progress=on_progress
        )

    def cancel(self) -> Self:
        """Cancel it; a job that has ended gives up its result instead. Twice is once."""
        self.told = self._client._json(self.request("DELETE"))  # noqa: SLF001
        return self


class AsyncJob(Told):
    """A job of an `AsyncClient`: the same as `Job`, awaited."""

    def __init__(self, client: "AsyncClient", told: Mapping[str, Any]) -> None:
        super().__init__(told)
        self._client = client

    async def refresh(self, *, timeout: float | None = None) -> Self:  # noqa: ASYNC109
        """Ask the service how it is; returns itself."""
        self.told = await self._client._json(self.request("GET"), timeout=timeout)  # noqa: SLF001
        return self

    async def wait(
        self,
        timeout: float | None = None,  # noqa: ASYNC109 - spans many calls
        on_progress: Progress | None = None,
    ) -> Self:
        """Wait until it has succeeded; as `Job.wait`."""
        watch = Watch(timeout, on_progress)
        while True:
            try:
                told = await self._client._json(  # noqa: SLF001
                    self.request("GET"), timeout=watch.within(self._client.timeout), max_retries=0
                )
            except PugeoError as failure:
                watch.missed(failure)
            else:
                self.told = told
                watch.seen(self)
                if self.finished:
                    self.check()
                    return self
            await asyncio.sleep(watch.pause())

    async def result(
        self,
        out: str | os.PathLike[str] | None = None,
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - as in `wait`
        on_progress: Progress | None = None,
    ) -> Result:
        """Wait until it has succeeded, and fetch the dense cloud; as `Job.result`."""
        sink = self.sink(out)
        await self.wait(timeout, on_progress)
        return await self._client._call(  # noqa: SLF001
            self.request("GET", "/result"), sink, timeout=timeout, on_progress=on_progress
        )

    async def cancel(self) -> Self:
        """Cancel it; as `Job.cancel`."""
        self.told = await self._client._json(self.request("DELETE"))  # noqa: SLF001
        return self
