# SPDX-License-Identifier: Apache-2.0
"""Asyncio connection to a service: one call with its deadline and retries."""

import asyncio
import os
from collections.abc import Callable
from typing import Any, TypeVar

from pugeo_client._attempts import Attempts, Progress
from pugeo_client._http import HTTP_ERRORS, checked_url, configuration_errors, httpx
from pugeo_client._receivers import DocumentReceiver, Receiver
from pugeo_client._requests import Request, address, base_headers
from pugeo_client._responses import MAX_ERROR_BYTES, byte_count, check_encoding
from pugeo_client.errors import ConfigurationError, PugeoError, StatusError, status_error

__all__ = ["AsyncConnection"]

T = TypeVar("T")


class AsyncConnection:
    """Sends requests of an `AsyncClient`, in one event loop; otherwise as `Connection`."""

    def __init__(
        self,
        base_url: str | None,
        *,
        api_key: str | None,
        timeout: float,
        max_retries: int,
        http_client: "httpx.AsyncClient | None",
    ) -> None:
        self.base_url = checked_url(address(base_url))
        self.timeout = timeout
        self.max_retries = max_retries
        self._headers = base_headers(api_key)
        self._given = http_client is not None
        with configuration_errors():
            self._http = http_client or httpx.AsyncClient()
        self._process: int | None = None

    async def call(
        self,
        request: Request,
        receiver: Receiver[T],
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - spans the retries
        max_retries: int | None = None,
        on_progress: Progress | None = None,
    ) -> T:
        """Send a request until it succeeds; as `Connection.call`."""
        attempts = Attempts(
            request,
            url=self.base_url,
            timeout=self.timeout if timeout is None else timeout,
            max_retries=self.max_retries if max_retries is None else max_retries,
            on_progress=on_progress,
        )
        while True:
            try:
                async with asyncio.timeout(attempts.remaining):
                    return await self._attempt(attempts, receiver)
            except PugeoError as failure:
                delay = attempts.delay_after(failure)
            except TimeoutError as error:
                raise attempts.deadline_error() from error
            await asyncio.sleep(delay)

    async def document(
        self,
        request: Request,
        read: Callable[[dict[str, Any]], T],
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - spans the retries
        max_retries: int | None = None,
        on_progress: Progress | None = None,
    ) -> T:
        """Make a call whose answer is a JSON object; ``read`` turns it into the result."""
        return await self.call(
            request,
            DocumentReceiver(read),
            timeout=timeout,
            max_retries=max_retries,
            on_progress=on_progress,
        )

    async def aclose(self) -> None:
        """Close the sockets, unless the HTTP client was given."""
        if not self._given:
            await self._http.aclose()

    async def _attempt(self, attempts: Attempts, receiver: Receiver[T]) -> T:
        request, body = attempts.request, attempts.request.body
        counter = attempts.byte_counter("send", (body and body.length) or 0)
        try:
            async with self._http_of_this_process().stream(
                request.method,
                self.base_url + request.path,
                params=request.params,
                headers={**self._headers, **attempts.headers()},
                content=body.achunks(counter) if body else None,
                timeout=attempts.timeouts(),
            ) as response:
                if not response.is_success:
                    raise await self._status_error(response)
                check_encoding(response.headers)
                counter = attempts.byte_counter(
                    "receive", byte_count(response.headers), report=receiver.reports_progress
                )
                with receiver.open():
                    async for chunk in response.aiter_bytes():
                        counter(chunk)
                        receiver.write(chunk)
                    await asyncio.to_thread(receiver.check, response.headers)
                return receiver.result(response.headers)
        except HTTP_ERRORS as error:
            raise attempts.error_from(error) from error

    async def _status_error(self, response: "httpx.Response") -> StatusError:
        """Read the beginning of an error answer; nothing of one that is compressed."""
        body = b""
        if not response.headers.get("content-encoding"):
            async for chunk in response.aiter_bytes():
                body += chunk
                if len(body) >= MAX_ERROR_BYTES:
                    break
        return status_error(response.status_code, response.headers, body[:MAX_ERROR_BYTES])

    def _http_of_this_process(self) -> "httpx.AsyncClient":
        process = os.getpid()
        if self._process not in {None, process}:
            if self._given:
                raise ConfigurationError(
                    "this client was used before the process forked, and its http_client cannot "
                    "be shared: make an AsyncClient in each process"
                )
            # Kept: if it were collected here, its sockets would be reported as not closed.
            self._inherited = self._http
            with configuration_errors():
                self._http = httpx.AsyncClient()
        self._process = process
        return self._http
