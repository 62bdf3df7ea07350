# SPDX-License-Identifier: Apache-2.0
"""The client for asyncio programs: the same calls, awaited."""

import asyncio
import os
from collections import deque
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any, Self, Unpack

from pugeo_client import _wire
from pugeo_client._attempts import Attempts, Progress
from pugeo_client._http import httpx
from pugeo_client._job import job_request, list_request, submission
from pugeo_client._result import Result
from pugeo_client._sink import Sink
from pugeo_client._source import Source
from pugeo_client._wire import Options, Request
from pugeo_client.errors import PugeoError, status_error
from pugeo_client.jobs import AsyncJob

__all__ = ["AsyncClient"]


class AsyncClient:
    """A connection to a pugeo service. Make one and keep it: it reuses its sockets.

    Use it from one event loop.

    Example:
        >>> async with AsyncClient("http://127.0.0.1:8000") as client:  # doctest: +SKIP
        ...     dense = await client.upsample("scan.ply", ratio=8)
        ...     dense.save("dense.ply")

    Args:
        base_url: address of the service; ``PUGEO_URL`` or this machine's port 8000 by default.
        api_key: sent as a bearer token; ``PUGEO_API_KEY`` by default.
        timeout: seconds for a whole call, retries and the waits between them included.
        max_retries: tries after failures that may pass; 0 for none. A service that is full and
            says when to come again (429, 503) is no failure: it is asked until ``timeout``.
        http_client: your own HTTP client (proxies, certificates, pools); you close it.
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
        self.base_url = _wire.base_url(base_url)
        self.timeout = timeout
        self.max_retries = max_retries
        self._headers = _wire.base_headers(api_key)
        self._own = http_client is None
        self._http = http_client or httpx.AsyncClient()

    async def upsample(
        self,
        src: Source,
        ratio: float = 4,
        *,
        out: str | os.PathLike[str] | None = None,
        format: str | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - a limit on retries too
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Result:
        """Make a cloud denser; arguments, result and errors are those of `Client.upsample`."""
        target = None if out is None else Path(out)
        answer = format if format and target else _wire.default_format(target)
        request = _wire.upsample_request(src, ratio, answer, **options)
        sink = Sink(format=answer, out=target)
        return await self._call(request, sink, timeout=timeout, on_progress=on_progress)

    async def map(
        self, sources: Iterable[Source], ratio: float = 4, *, concurrency: int = 4, **options: Any
    ) -> AsyncIterator[Result]:
        """Make many clouds denser, a few at a time, and give the results in order.

        As `Client.map`; leaving the loop early cancels the calls that still run.
        """
        running: deque[asyncio.Task[Result]] = deque()
        try:
            for source in sources:
                running.append(asyncio.create_task(self.upsample(source, ratio, **options)))
                if len(running) >= concurrency:
                    yield await running.popleft()
            while running:
                yield await running.popleft()
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)

    async def submit(
        self,
        src: Source,
        ratio: float = 4,
        *,
        format: str = "ply",
        idempotency_key: str | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - a limit on retries too
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> AsyncJob:
        """Hand a cloud over to be made denser later; arguments as in `Client.submit`."""
        request = _wire.upsample_request(src, ratio, format, **options)
        answer = await self._call(
            submission(request, idempotency_key),
            Sink(format="json", out=None),
            timeout=timeout,
            on_progress=on_progress,
        )
        return AsyncJob(self, _wire.read_json(answer.data))

    async def job(self, job_id: str) -> AsyncJob:
        """Find a job by its id."""
        return AsyncJob(self, await self._json(job_request(job_id)))

    async def jobs(self, *, state: str | None = None) -> AsyncIterator[AsyncJob]:
        """Give all jobs of this API key, newest first, or those in one state."""
        cursor = None
        while True:
            page = await self._json(list_request(state, cursor))
            for told in page["jobs"]:
                yield AsyncJob(self, told)
            cursor = page["next"]
            if cursor is None:
                return

    async def health(self) -> dict[str, Any]:
        """How the service is now: status, reason, version, workers, queue. Never retried."""
        report: dict[str, Any] = await self._json(Request("GET", "/health"), max_retries=0)
        return report

    async def models(self) -> list[dict[str, Any]]:
        """The model cards: name, version, checksum, ratio range, training data, quality."""
        cards: list[dict[str, Any]] = (await self._json(Request("GET", "/models")))["models"]
        return cards

    async def aclose(self) -> None:
        """Close the sockets, unless the HTTP client was given."""
        if self._own:
            await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()

    async def _json(
        self,
        request: Request,
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - as in `_call`
        max_retries: int | None = None,
    ) -> Any:
        sink = Sink(format="json", out=None)
        answer = await self._call(request, sink, timeout=timeout, max_retries=max_retries)
        return _wire.read_json(answer.data)

    async def _call(
        self,
        request: Request,
        sink: Sink,
        *,
        timeout: float | None = None,  # noqa: ASYNC109
        max_retries: int | None = None,
        on_progress: Progress | None = None,
    ) -> Result:
        attempts = Attempts(
            request,
            timeout=self.timeout if timeout is None else timeout,
            max_retries=self.max_retries if max_retries is None else max_retries,
            on_progress=on_progress,
        )
        while True:
            try:
                async with asyncio.timeout(attempts.remaining):
                    return await self._try(attempts, sink)
            except PugeoError as failure:
                delay = attempts.wait_after(failure)
            except TimeoutError as error:
                raise attempts.too_late() from error
            await asyncio.sleep(delay)

    async def _try(self, attempts: Attempts, sink: Sink) -> Result:
        request, body = attempts.request, attempts.request.body
        try:
            async with self._http.stream(
                request.method,
                self.base_url + request.path,
                params=request.params,
                headers={**self._headers, **attempts.headers()},
                content=body.achunks(attempts.meter("send")) if body else None,
                timeout=attempts.phases(),
            ) as response:
                if not response.is_success:
                    raise status_error(
                        response.status_code, response.headers, await response.aread()
                    )
                received = attempts.meter("receive", response.headers)
                with sink.open():
                    async for chunk in response.aiter_bytes():
                        received(chunk)
                        sink.write(chunk)
                return sink.result(response.headers)
        except httpx.TransportError as error:
            raise attempts.translate(error) from error
