# SPDX-License-Identifier: Apache-2.0
"""End of worker processes that may hang."""

import contextlib
from collections.abc import Iterable

import psutil

__all__ = ["end_children", "end_processes"]


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


def _is_worker(process: psutil.Process) -> bool:
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False
