# SPDX-License-Identifier: Apache-2.0
"""Blocking connection to a service: one call with its deadline and retries."""

import os
from collections.abc import Callable
from typing import Any, TypeVar

from pugeo_client import _blocking_io
from pugeo_client._attempts import Attempts, Progress
from pugeo_client._http import HTTP_ERRORS, checked_url, configuration_errors, httpx
from pugeo_client._receivers import DocumentReceiver, Receiver
from pugeo_client._requests import Request, address, base_headers
from pugeo_client._responses import MAX_ERROR_BYTES, byte_count, check_encoding
from pugeo_client.errors import ConfigurationError, PugeoError, StatusError, status_error

__all__ = ["Connection"]

T = TypeVar("T")


class Connection:
    """Sends requests of a `Client`; may be shared between threads.

    A forked child opens its own connections: on shared ones, parent and child could read each
    other's responses.

    Args:
        base_url: see `Client`, as for the following.
    """

    def __init__(
        self,
        base_url: str | None,
        *,
        api_key: str | None,
        timeout: float,
        max_retries: int,
        http_client: "httpx.Client | None",
    ) -> None:
        self.base_url = checked_url(address(base_url))
        self.timeout = timeout
        self.max_retries = max_retries
        self._headers = base_headers(api_key)
        self._given = http_client is not None
        with configuration_errors():
            self._http = http_client or httpx.Client()
        self._process: int | None = None

    def call(
        self,
        request: Request,
        receiver: Receiver[T],
        *,
        timeout: float | None = None,
        max_retries: int | None = None,
        on_progress: Progress | None = None,
    ) -> T:
        """Send a request until it succeeds or is not to be retried, and receive the answer.

        Args:
            request: what to send.
            receiver: takes the answer.
            timeout: seconds for all attempts; the default of the connection for None.
            max_retries: likewise.
            on_progress: see `Progress`.

        Raises:
            PugeoError: the failure of the last attempt.
        """
        attempts = Attempts(
            request,
            url=self.base_url,
            timeout=self.timeout if timeout is None else timeout,
            max_retries=self.max_retries if max_retries is None else max_retries,
            on_progress=on_progress,
        )
        while True:
            try:
                with _blocking_io.bounded_io(attempts.checked_remaining):
                    return self._attempt(attempts, receiver)
            except PugeoError as failure:
                delay = attempts.delay_after(failure)
            _blocking_io.wait(delay)

    def document(
        self,
        request: Request,
        read: Callable[[dict[str, Any]], T],
        *,
        timeout: float | None = None,
        max_retries: int | None = None,
        on_progress: Progress | None = None,
    ) -> T:
        """Make a call whose answer is a JSON object; ``read`` turns it into the result."""
        return self.call(
            request,
            DocumentReceiver(read),
            timeout=timeout,
            max_retries=max_retries,
            on_progress=on_progress,
        )

    def close(self) -> None:
        """Close the sockets, unless the HTTP client was given."""
        if not self._given:
            self._http.close()

    def _attempt(self, attempts: Attempts, receiver: Receiver[T]) -> T:
        request, body = attempts.request, attempts.request.body
        counter = attempts.byte_counter("send", (body and body.length) or 0)
        try:
            with self._http_of_this_process().stream(
                request.method,
                self.base_url + request.path,
                params=request.params,
                headers={**self._headers, **attempts.headers()},
                content=body.chunks(counter) if body else None,
                timeout=attempts.timeouts(),
                extensions={"trace": _blocking_io.bounding_trace},
            ) as response:
                if not response.is_success:
                    raise self._status_error(response)
                check_encoding(response.headers)
                counter = attempts.byte_counter(
                    "receive", byte_count(response.headers), report=receiver.reports_progress
                )
                with receiver.open():
                    for chunk in response.iter_bytes():
                        counter(chunk)
                        receiver.write(chunk)
                    receiver.check(response.headers)
                return receiver.result(response.headers)
        except HTTP_ERRORS as error:
            raise attempts.error_from(error) from error

    def _status_error(self, response: "httpx.Response") -> StatusError:
        """Read the beginning of an error answer; nothing of one that is compressed."""
        body = b""
        if not response.headers.get("content-encoding"):
            for chunk in response.iter_bytes():
                body += chunk
                if len(body) >= MAX_ERROR_BYTES:
                    break
        return status_error(response.status_code, response.headers, body[:MAX_ERROR_BYTES])

    def _http_of_this_process(self) -> "httpx.Client":
        process = os.getpid()
        if self._process not in {None, process}:
            if self._given:
                raise ConfigurationError(
                    "this client was used before the process forked, and its http_client cannot "
                    "be shared: make a Client in each process"
                )
            # Kept: if it were collected here, its sockets would be reported as not closed.
            self._inherited = self._http
            with configuration_errors():
                self._http = httpx.Client()
        self._process = process
        return self._http
