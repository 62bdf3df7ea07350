# SPDX-License-Identifier: Apache-2.0
"""Client for asyncio: the same calls as the blocking one, awaited."""

import asyncio
import contextlib
import os
import time
from collections import deque
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any, Self, Unpack

from pugeo_client._aconnection import AsyncConnection
from pugeo_client._attempts import Progress
from pugeo_client._batch import OutputFolder, with_source
from pugeo_client._http import httpx
from pugeo_client._job_record import next_cursor
from pugeo_client._receivers import CloudReceiver
from pugeo_client._requests import (
    Options,
    Request,
    format_of,
    job_request,
    list_request,
    submit_request,
    upsample_request,
)
from pugeo_client._responses import read_cards
from pugeo_client._result import Result
from pugeo_client._retry import worth_a_job
from pugeo_client._source import Source
from pugeo_client.errors import PugeoError, ServerDeadlineError, StatusError
from pugeo_client.jobs import AsyncJob

__all__ = ["AsyncClient"]

_CANCEL_S = 5.0


class AsyncClient:
    """Client of a pugeo service. Make one and keep it: it reuses its connections.

    Use it in one event loop.

    Example:
        >>> async with AsyncClient("http://127.0.0.1:8000") as client:  # doctest: +SKIP
        ...     dense = await client.upsample("scan.ply", ratio=8)
        ...     dense.save("dense.ply")

    Args:
        base_url: address of the service; ``PUGEO_URL`` or port 8000 of this machine by default.
        api_key: sent as a bearer token; ``PUGEO_API_KEY`` by default.
        timeout: seconds for a whole call, including retries and the waits between them.
        max_retries: retries after transient failures; 0 for none. Overload of the service (429
            or 503 with ``Retry-After``) does not count and is retried until ``timeout``.
        http_client: an HTTP client of your own (proxies, certificates, pools); you close it.

    Raises:
        ConfigurationError: the address, the key, a proxy or a certificate cannot be used.
    """

    def __init__(
        self,
        base_url: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float = 600.0,
        max_retries: int = 3,
        http_client: "httpx.AsyncClient | None" = None,
    ) -> None:
        self._connection = AsyncConnection(
            base_url,
            api_key=api_key,
            timeout=timeout,
            max_retries=max_retries,
            http_client=http_client,
        )

    @property
    def base_url(self) -> str:
        """Address of the service."""
        return self._connection.base_url

    @property
    def timeout(self) -> float:
        """Seconds for a whole call."""
        return self._connection.timeout

    @property
    def max_retries(self) -> int:
        """Retries after transient failures."""
        return self._connection.max_retries

    async def upsample(
        self,
        src: Source,
        ratio: float | None = None,
        *,
        out: str | os.PathLike[str] | None = None,
        format: str | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - spans the retries
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Result:
        """Upsample a point cloud; arguments, result and errors are those of `Client.upsample`."""
        target = None if out is None else Path(out)
        written = format or format_of(target)
        request = upsample_request(src, ratio, written, **options)
        receiver = CloudReceiver(format=written, out=target)
        end = time.monotonic() + (self._connection.timeout if timeout is None else timeout)
        try:
            return await self._connection.call(
                request, receiver, timeout=timeout, on_progress=on_progress
            )
        except ServerDeadlineError as failure:
            if not request.sendable or not worth_a_job(failure, end - time.monotonic()):
                raise
            return await self._upsample_as_job(request, receiver, failure, end, on_progress)

    async def _upsample_as_job(
        self,
        request: Request,
        receiver: CloudReceiver,
        failure: ServerDeadlineError,
        end: float,
        on_progress: Progress | None,
    ) -> Result:
        try:
            job = await self._submit(request, None, None, end - time.monotonic(), on_progress)
        except StatusError as refusal:
            raise failure from refusal
        try:
            await job.wait(end - time.monotonic(), on_progress)
            return await self._connection.call(
                job.request("GET", "/result"),
                receiver,
                timeout=end - time.monotonic(),
                on_progress=on_progress,
            )
        except BaseException:
            # Cancel the job: the caller never received its id.
            with contextlib.suppress(PugeoError):
                await job.cancel(timeout=_CANCEL_S)
            raise

    def map(
        self,
        sources: Iterable[Source],
        ratio: float | None = None,
        *,
        concurrency: int = 4,
        out: str | os.PathLike[str] | None = None,
        format: str | None = None,
        **options: Any,
    ) -> AsyncIterator[Result | PugeoError | OSError]:
        """Upsample many clouds, a few at a time, and yield the results in order; as `Client.map`.

        Leaving the loop early cancels the calls that still run, when the iterator is closed.
        """
        folder = None if out is None else OutputFolder(out, format)

        async def call(number: int, source: Source) -> Result | PugeoError | OSError:
            try:
                file = None if folder is None else folder.path_for(number, source)
                return await self.upsample(source, ratio, out=file, format=format, **options)
            except (PugeoError, OSError) as error:
                return with_source(error, number, source)

        async def results() -> AsyncIterator[Result | PugeoError | OSError]:
            running: deque[asyncio.Task[Result | PugeoError | OSError]] = deque()
            try:
                for number, source in enumerate(sources):
                    running.append(asyncio.create_task(call(number, source)))
                    if len(running) >= concurrency:
                        yield await running.popleft()
                while running:
                    yield await running.popleft()
            finally:
                for task in running:
                    task.cancel()
                await asyncio.gather(*running, return_exceptions=True)

        return results()

    async def submit(
        self,
        src: Source,
        ratio: float | None = None,
        *,
        format: str = "ply",
        idempotency_key: str | None = None,
        webhook: str | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - spans the retries
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> AsyncJob:
        """Submit a cloud as a job; arguments, result and errors are those of `Client.submit`."""
        request = upsample_request(src, ratio, format, **options)
        return await self._submit(request, idempotency_key, webhook, timeout, on_progress)

    async def _submit(
        self,
        upsample: Request,
        key: str | None,
        webhook: str | None,
        timeout: float | None,  # noqa: ASYNC109 - spans the retries
        on_progress: Progress | None,
    ) -> AsyncJob:
        return AsyncJob(
            self._connection,
            await self._connection.document(
                submit_request(upsample, key, webhook),
                dict,
                timeout=timeout,
                on_progress=on_progress,
            ),
        )

    async def job(self, job_id: str) -> AsyncJob:
        """Find a job by its id."""
        return AsyncJob(
            self._connection, await self._connection.document(job_request("GET", job_id), dict)
        )

    async def jobs(self, *, state: str | None = None) -> AsyncIterator[AsyncJob]:
        """Yield all jobs of this API key, newest first, or those in one state."""
        cursor: str | None = None
        seen: set[str] = set()
        while True:
            page = await self._connection.document(list_request(state, cursor), dict)
            cursor = next_cursor(page, seen)
            for record in page["jobs"]:
                yield AsyncJob(self._connection, record)
            if cursor is None:
                return

    async def health(self) -> dict[str, Any]:
        """Return the health of the service: status, reason, version, workers, queue. No retries."""
        return await self._connection.document(Request("GET", "/health"), dict, max_retries=0)

    async def models(self) -> list[dict[str, Any]]:
        """Return the model cards: name, version, checksum, ratio range, training data, quality."""
        return await self._connection.document(Request("GET", "/models"), read_cards)

    async def aclose(self) -> None:
        """Close the connections, unless the HTTP client was given."""
        await self._connection.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()
