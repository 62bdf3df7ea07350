# SPDX-License-Identifier: Apache-2.0
"""The client that waits."""

import os
import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
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
from pugeo_client.jobs import Job

__all__ = ["Client", "upsample"]


class Client:
    """A connection to a pugeo service. Make one and keep it: it reuses its sockets.

    Safe to share between threads.

    Example:
        >>> with Client("http://127.0.0.1:8000") as client:  # doctest: +SKIP
        ...     dense = client.upsample("scan.ply", ratio=8)
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
        http_client: "httpx.Client | None" = None,
    ) -> None:
        self.base_url = _wire.base_url(base_url)
        self.timeout = timeout
        self.max_retries = max_retries
        self._headers = _wire.base_headers(api_key)
        self._own = http_client is None
        self._http = http_client or httpx.Client()

    def upsample(
        self,
        src: Source,
        ratio: float = 4,
        *,
        out: str | os.PathLike[str] | None = None,
        format: str | None = None,
        timeout: float | None = None,
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Result:
        """Make a cloud denser.

        Args:
            src: a path, bytes or an open binary file of PLY, NPZ, NPY, JSON or XYZ; an ``(N, 3)``
                or ``(N, 6)`` array (columns 4 to 6 are normals); or a dict of arrays ``points``,
                ``normals``, ``colors``, ``scalars``. Files are streamed, never held in memory.
            ratio: how many times as many points, any number from 1 to 32.
            out: file to stream the answer to; it appears when it is complete.
            format: of ``out``: ``ply``, ``ply-ascii``, ``npz``, ``json``, ``xyz``; by its
                extension by default.
            timeout: seconds for this call; the client's own by default.
            on_progress: called with a stage (``"send"``, ``"receive"``), bytes done, bytes in all.
            **options: ``n_points`` (exactly so many, instead of ``ratio``), ``orient``,
                ``viewpoint``, ``seed``, ``keep_input``; see `Options`.

        Returns:
            The dense cloud, with what the service said about it.

        Raises:
            SourceError: ``src`` cannot be sent.
            StatusError: the service refused; see `pugeo_client.errors` for its kinds.
            ConnectionFailedError: no answer, or none within ``timeout`` (``DeadlineExceededError``).
        """
        target = None if out is None else Path(out)
        answer = format if format and target else _wire.default_format(target)
        request = _wire.upsample_request(src, ratio, answer, **options)
        sink = Sink(format=answer, out=target)
        return self._call(request, sink, timeout=timeout, on_progress=on_progress)

    def map(
        self, sources: Iterable[Source], ratio: float = 4, *, concurrency: int = 4, **options: Any
    ) -> Iterator[Result]:
        """Make many clouds denser, a few at a time, and give the results in order.

        At most ``concurrency`` results wait to be taken, so that memory stays bounded. A cloud
        that fails raises when its turn comes; the calls that already run still end.

        Args:
            sources: any number of what `upsample` takes.
            ratio: as in `upsample`.
            concurrency: calls at the same time.
            **options: as in `upsample`, the same for all.
        """
        with ThreadPoolExecutor(concurrency, thread_name_prefix="pugeo") as pool:
            running: deque[Future[Result]] = deque()
            try:
                for source in sources:
                    running.append(pool.submit(self.upsample, source, ratio, **options))
                    if len(running) >= concurrency:
                        yield running.popleft().result()
                while running:
                    yield running.popleft().result()
            finally:
                for waiting in running:
                    waiting.cancel()

    def submit(
        self,
        src: Source,
        ratio: float = 4,
        *,
        format: str = "ply",
        idempotency_key: str | None = None,
        timeout: float | None = None,
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Job:
        """Hand a cloud over to be made denser later, also across restarts of the service.

        Returns as soon as the service has the cloud safely on its disk.

        Args:
            src: as in `upsample`, like the other options that are not explained here.
            ratio: how many times as many points.
            format: of the result: ``ply``, ``ply-ascii``, ``npz``, ``json``, ``xyz``.
            idempotency_key: your own name of this job: submitting the same again under it gives
                the same job, also from another process. By default a new one for each call.
            timeout: seconds to hand it over; the client's own by default.
            on_progress: called with ``"send"``, bytes done, bytes in all.
            **options: as in `upsample`.

        Raises:
            UnprocessableError: the key was used for another cloud or other options.
            PugeoError: as `upsample`.
        """
        request = _wire.upsample_request(src, ratio, format, **options)
        answer = self._call(
            submission(request, idempotency_key),
            Sink(format="json", out=None),
            timeout=timeout,
            on_progress=on_progress,
        )
        return Job(self, _wire.read_json(answer.data))

    def job(self, job_id: str) -> Job:
        """Find a job by its id."""
        return Job(self, self._json(job_request(job_id)))

    def jobs(self, *, state: str | None = None) -> Iterator[Job]:
        """Give all jobs of this API key, newest first, or those in one state."""
        cursor = None
        while True:
            page = self._json(list_request(state, cursor))
            for told in page["jobs"]:
                yield Job(self, told)
            cursor = page["next"]
            if cursor is None:
                return

    def health(self) -> dict[str, Any]:
        """How the service is now: status, reason, version, workers, queue. Never retried."""
        report: dict[str, Any] = self._json(Request("GET", "/health"), max_retries=0)
        return report

    def models(self) -> list[dict[str, Any]]:
        """The model cards: name, version, checksum, ratio range, training data, quality."""
        cards: list[dict[str, Any]] = self._json(Request("GET", "/models"))["models"]
        return cards

    def close(self) -> None:
        """Close the sockets, unless the HTTP client was given."""
        if self._own:
            self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _json(
        self, request: Request, *, timeout: float | None = None, max_retries: int | None = None
    ) -> Any:
        sink = Sink(format="json", out=None)
        answer = self._call(request, sink, timeout=timeout, max_retries=max_retries)
        return _wire.read_json(answer.data)

    def _call(
        self,
        request: Request,
        sink: Sink,
        *,
        timeout: float | None = None,
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
                return self._try(attempts, sink)
            except PugeoError as failure:
                delay = attempts.wait_after(failure)
            time.sleep(delay)

    def _try(self, attempts: Attempts, sink: Sink) -> Result:
        request, body = attempts.request, attempts.request.body
        try:
            with self._http.stream(
                request.method,
                self.base_url + request.path,
                params=request.params,
                headers={**self._headers, **attempts.headers()},
                content=body.chunks(attempts.meter("send")) if body else None,
                timeout=attempts.phases(),
            ) as response:
                if not response.is_success:
                    raise status_error(response.status_code, response.headers, response.read())
                received = attempts.meter("receive", response.headers)
                with sink.open():
                    for chunk in response.iter_bytes():
                        received(chunk)
                        sink.write(chunk)
                return sink.result(response.headers)
        except httpx.TransportError as error:
            raise attempts.translate(error) from error


def upsample(src: Source, ratio: float = 4, **options: Any) -> Result:
    """Make one cloud denser with the service at ``PUGEO_URL``; see `Client.upsample`."""
    with Client() as client:
        return client.upsample(src, ratio, **options)
