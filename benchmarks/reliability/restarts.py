# SPDX-License-Identifier: Apache-2.0
"""A service that is started again after its death: same address, same jobs."""

import contextlib
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import httpx2
from tests.e2e.conftest import launched
from tests.free_port import free_port

from benchmarks.reliability.service import READY_S, Server

__all__ = ["Phoenix"]

_WORKERS = 2
_LOOK_S = 0.1


class Phoenix:
    """A service and its successors.

    Args:
        folder: for jobs, files and logs.

    Attributes:
        url: of all of them.
        server: the present one.
    """

    server: Server

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._opened = contextlib.ExitStack()
        self._lives = 0
        self._port = free_port()
        self.url = f"http://127.0.0.1:{self._port}"

    def __enter__(self) -> Self:
        for name in ("jobs", "spool"):
            (self._folder / name).mkdir()
        self.rise()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._opened.close()

    def rise(self) -> None:
        """Start the next one and wait until it is ready.

        Raises:
            pytest.fail.Exception: it does not become ready; the message has the end of its log.
        """
        self._opened.close()
        self._lives += 1
        self.server = self._opened.enter_context(
            launched(
                self._folder / f"server-{self._lives}.log",
                *("--port", str(self._port), "--workers", str(_WORKERS)),
                PUGEO_JOBS_DIR=str(self._folder / "jobs"),
                # Kills come every 17 s: five of them during one job say nothing about that job.
                PUGEO_JOBS_ATTEMPTS="1000",
                PUGEO_SPOOL_DIR=str(self._folder / "spool"),
            )
        )
        self.server.wait_until_ready(READY_S)

    def until_all_warm(self) -> None:
        """Wait until no worker is missing.

        Raises:
            TimeoutError: one does not come back.
        """
        end = time.monotonic() + READY_S
        # The service looks twice a second: what it says now may be older than the kill.
        time.sleep(1.0)
        while time.monotonic() < end:
            if httpx2.get(f"{self.url}/health", timeout=30).json()["workers"] == _WORKERS:
                return
            time.sleep(_LOOK_S)
        raise TimeoutError("a worker did not come back")
