# SPDX-License-Identifier: Apache-2.0
"""Checks of the machine before anything starts.

Without them the same faults end worker processes, one traceback each, while the front waits.
"""

import multiprocessing
import sys
from pathlib import Path

from pugeo_service.settings import Settings

__all__ = ["unfit_machine"]

_PROC = Path("/proc/self/stat")


def unfit_machine(settings: Settings) -> str | None:
    """Return a line about a part of the system that worker processes need and that is missing."""
    if settings.engine == "inline":
        return None
    if sys.platform == "linux" and not _PROC.exists():
        return "/proc is not mounted; the service watches its worker processes there"
    try:
        multiprocessing.get_context("spawn").Lock()
    except (OSError, ImportError) as error:
        return (
            f"worker processes need a writable /dev/shm ({error}); containers get one by "
            "--shm-size=64m or --tmpfs /dev/shm"
        )
    return None
