# SPDX-License-Identifier: Apache-2.0
"""Blocking client."""

import contextlib
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Self, Unpack

from pugeo_client import _blocking_io
from pugeo_client._attempts import Progress
from pugeo_client._batch import OutputFolder, map_in_threads, with_source
from pugeo_client._connection import Connection
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
from pugeo_client.jobs import Job

__all__ = ["Client", "upsample"]

_CANCEL_S = 5.0


class Client:
    """Client of a pugeo service. Make one and keep it: it reuses its connections.

    May be shared between threads, and used in forked processes.

    Example:
        >>> with Client("http://127.0.0.1:8000") as client:  # doctest: +SKIP
        ...     dense = client.upsample("scan.ply", ratio=8)
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
        http_client: "httpx.Client | None" = None,
    ) -> None:
        self._connection = Connection(
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

    def upsample(
        self,
        src: Source,
        ratio: float | None = None,
        *,
        out: str | os.PathLike[str] | None = None,
        format: str | None = None,
        timeout: float | None = None,
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Result:
        """Upsample a point cloud.

        A cloud that the service cannot finish within its own time limit is submitted as a job,
        if ``timeout`` is longer than that limit.

        Args:
            src: a path, bytes or an open binary file of any format that the service reads; an
                ``(N, 3)`` or ``(N, 6)`` array, list or torch tensor (columns 4 to 6 are normals);
                an Open3D cloud; or a dict of arrays ``points``, ``normals``, ``colors``,
                ``scalars``. Files are streamed, never held in memory.
            ratio: output points per input point, any number from 1 to 32; 4 by default.
            out: output file; it is written atomically.
            format: of the answer, such as ``ply``, ``ply-ascii`` or ``laz``; by default that of
                the extension of ``out``, or ``ply``.
            timeout: seconds for this call; that of the client by default.
            on_progress: called with a stage (``"send"``, ``"receive"``), bytes done, bytes in
                total.
            **options: ``R`` (the same as ``ratio``), ``n_points``, ``orient``, ``viewpoint``,
                ``seed``, ``keep_input``; see `Options`.

        Returns:
            The dense cloud and its description.

        Raises:
            SourceError: ``src`` or an option cannot be sent.
            StatusError: the service refused; see `pugeo_client.errors` for its kinds.
            ConnectionFailedError: no answer, or none in time (``DeadlineExceededError``).
            InvalidResponseError: the answer is not the promised cloud; ``out`` is unchanged.
            OSError: ``src`` cannot be read, or ``out`` cannot be written.
        """
        target = None if out is None else Path(out)
        written = format or format_of(target)
        request = upsample_request(src, ratio, written, **options)
        receiver = CloudReceiver(format=written, out=target)
        end = time.monotonic() + (self._connection.timeout if timeout is None else timeout)
        try:
            return self._connection.call(
                request, receiver, timeout=timeout, on_progress=on_progress
            )
        except ServerDeadlineError as failure:
            if not request.sendable or not worth_a_job(failure, end - time.monotonic()):
                raise
            return self._upsample_as_job(request, receiver, failure, end, on_progress)

    def _upsample_as_job(
        self,
        request: Request,
        receiver: CloudReceiver,
        failure: ServerDeadlineError,
        end: float,
        on_progress: Progress | None,
    ) -> Result:
        try:
            job = self._submit(request, None, None, end - time.monotonic(), on_progress)
        except StatusError as refusal:
            raise failure from refusal
        try:
            job.wait(end - time.monotonic(), on_progress)
            return self._connection.call(
                job.request("GET", "/result"),
                receiver,
                timeout=end - time.monotonic(),
                on_progress=on_progress,
            )
        except BaseException:
            # Cancel the job: the caller never received its id.
            with _blocking_io.interruptible(None), contextlib.suppress(PugeoError):
                job.cancel(timeout=_CANCEL_S)
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
    ) -> Iterator[Result | PugeoError | OSError]:
        """Upsample many clouds, a few at a time, and yield the results in order.

        At most ``concurrency`` results wait to be taken, so that memory stays bounded. The error
        of a cloud is yielded in its place, and the others go on. Leaving the loop, or Ctrl-C,
        interrupts the calls that still run.

        Example:
            >>> for dense in client.map(paths, 4, out="dense"):  # doctest: +SKIP
            ...     if isinstance(dense, Exception):
            ...         print(dense, dense.__notes__)

        Args:
            sources: inputs of `upsample`.
            ratio: as in `upsample`.
            concurrency: number of calls at the same time.
            out: folder of one output file for each source, under the name of the source.
            format: of the output files; by default that of the source where it can be written.
            **options: as in `upsample`, the same for all.

        Raises:
            OSError: the folder cannot be made.
        """
        folder = None if out is None else OutputFolder(out, format)

        def call(item: tuple[int, Source]) -> Result | PugeoError | OSError:
            number, source = item
            try:
                file = None if folder is None else folder.path_for(number, source)
                return self.upsample(source, ratio, out=file, format=format, **options)
            except (PugeoError, OSError) as error:
                return with_source(error, number, source)

        return map_in_threads(call, enumerate(sources), concurrency)

    def submit(
        self,
        src: Source,
        ratio: float | None = None,
        *,
        format: str = "ply",
        idempotency_key: str | None = None,
        webhook: str | None = None,
        timeout: float | None = None,
        on_progress: Progress | None = None,
        **options: Unpack[Options],
    ) -> Job:
        """Submit a cloud as a job, which survives restarts of the service.

        Returns as soon as the service has stored the cloud on its disk.

        Args:
            src: as in `upsample`, like the options that are not explained here.
            ratio: output points per input point.
            format: of the result, as in `upsample`.
            idempotency_key: name of the job: submitting the same again under it returns the same
                job, also from another process. By default a random one for each call.
            webhook: address that gets a signed POST when the job has ended.
            timeout: seconds for the submission; that of the client by default.
            on_progress: called with ``"send"``, bytes done, bytes in total.
            **options: as in `upsample`.

        Raises:
            UnprocessableError: the key was used for another cloud or other options.
            PugeoError: as `upsample`.
        """
        request = upsample_request(src, ratio, format, **options)
        return self._submit(request, idempotency_key, webhook, timeout, on_progress)

    def _submit(
        self,
        upsample: Request,
        key: str | None,
        webhook: str | None,
        timeout: float | None,
        on_progress: Progress | None,
    ) -> Job:
        return Job(
            self._connection,
            self._connection.document(
                submit_request(upsample, key, webhook),
                dict,
                timeout=timeout,
                on_progress=on_progress,
            ),
        )

    def job(self, job_id: str) -> Job:
        """Find a job by its id."""
        return Job(self._connection, self._connection.document(job_request("GET", job_id), dict))

    def jobs(self, *, state: str | None = None) -> Iterator[Job]:
        """Yield all jobs of this API key, newest first, or those in one state."""
        cursor: str | None = None
        seen: set[str] = set()
        while True:
            page = self._connection.document(list_request(state, cursor), dict)
            cursor = next_cursor(page, seen)
            for record in page["jobs"]:
                yield Job(self._connection, record)
            if cursor is None:
                return

    def health(self) -> dict[str, Any]:
        """Return the health of the service: status, reason, version, workers, queue. No retries."""
        return self._connection.document(Request("GET", "/health"), dict, max_retries=0)

    def models(self) -> list[dict[str, Any]]:
        """Return the model cards: name, version, checksum, ratio range, training data, quality."""
        return self._connection.document(Request("GET", "/models"), read_cards)

    def close(self) -> None:
        """Close the connections, unless the HTTP client was given."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def upsample(src: Source, ratio: float | None = None, **options: Any) -> Result:
    """Upsample one cloud with the service at ``PUGEO_URL``; see `Client.upsample`."""
    with Client() as client:
        return client.upsample(src, ratio, **options)
