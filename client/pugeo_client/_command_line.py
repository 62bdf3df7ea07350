# SPDX-License-Identifier: Apache-2.0
"""A service for ``pugeo upsample --url``: the command finds this class by its entry point."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from pugeo_client._batch import map_in_threads
from pugeo_client._client import Client
from pugeo_client._result import Result
from pugeo_client.errors import PugeoError

__all__ = ["CommandLineService"]

_TIMEOUT_S = 86_400.0  # a user at a terminal ends a long wait with Ctrl-C

T = TypeVar("T")
R = TypeVar("R")


class CommandLineService:
    """Upsamples files with a service.

    Args:
        url: address of the service; the key is ``PUGEO_API_KEY``.
        as_jobs: submit each cloud as a job, which survives restarts of the service.

    Attributes:
        error_type: base class of the errors that its calls raise.

    Raises:
        ConfigurationError: the address or the key cannot be used.
    """

    error_type = PugeoError

    def __init__(self, url: str, *, as_jobs: bool) -> None:
        self._client = Client(url, timeout=_TIMEOUT_S)
        self._as_jobs = as_jobs

    def upsample(
        self,
        source: Path | BinaryIO,
        target: Path | BinaryIO,
        format: str,
        options: dict[str, Any],
        progress: Callable[[str, int, int], None],
    ) -> dict[str, Any]:
        """Upsample a cloud; see `Client.upsample` and `Job.result`.

        Args:
            source: path or open file.
            target: path, or file that the answer is written to at the end.
            format: of the answer.
            options: of the run, by the names of `upsample`; a missing one has its default.
            progress: called with a stage, and the bytes or patches done and in total.

        Returns:
            ``points_in``, ``points_out``, ``dropped`` and ``notes``.
        """
        out = target if isinstance(target, Path) else None
        if self._as_jobs:
            job = self._client.submit(source, format=format, on_progress=progress, **options)
            result = job.result(out, on_progress=progress)
        else:
            result = self._client.upsample(
                source, out=out, format=format, on_progress=progress, **options
            )
        if not isinstance(target, Path):
            _copy(result, target)
        meta = result.meta
        return {
            "points_in": meta.points_in,
            "points_out": meta.points_out,
            "dropped": dict(meta.dropped),
            "notes": list(meta.notes),
        }

    def each(self, call: Callable[[T], R], items: Iterable[T], concurrency: int) -> Iterator[R]:
        """Make calls in threads and yield the results in order; leaving interrupts them."""
        return map_in_threads(call, items, concurrency)

    def close(self) -> None:
        """Close all connections."""
        self._client.close()


def _copy(result: Result, target: BinaryIO) -> None:
    assert result.data is not None
    target.write(result.data)
    target.flush()
