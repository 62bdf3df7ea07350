# SPDX-License-Identifier: Apache-2.0
"""End of this process and of worker processes, which may hang."""

import contextlib
import os
from collections.abc import Iterable

import psutil
import structlog

__all__ = ["end_at_once", "end_children", "end_processes"]

_log = structlog.stdlib.get_logger("pugeo.service")


def end_processes(processes: Iterable[psutil.Process]) -> None:
    """End processes, also stopped or hanging ones: the signal cannot be caught.

    A process that has ended is left out, even if the system has given its number to another one.
    """
    for process in processes:
        with contextlib.suppress(psutil.Error):
            process.kill()


def end_children() -> int:
    """End all worker processes below this process, whoever started them; return their number."""
    workers = [each for each in psutil.Process().children(recursive=True) if _is_worker(each)]
    end_processes(workers)
    return len(workers)


def end_at_once() -> None:
    """End this process with status 1, and its workers, whatever hangs; the log has a line."""
    _log.error("the process did not end in time; it is ended", workers=end_children())
    os._exit(1)


def _is_worker(process: psutil.Process) -> bool:
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False
