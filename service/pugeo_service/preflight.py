# SPDX-License-Identifier: Apache-2.0
"""Checks of the machine before anything starts.

Without them the same faults end worker processes, one traceback each, while the front waits.
"""

import errno
import multiprocessing
import socket
import sys
from pathlib import Path

from pugeo_service.settings import Settings

__all__ = ["unfit_machine", "unusable_host"]

_PROC = Path("/proc/self/stat")


def unfit_machine(settings: Settings) -> str | None:
    """Return a line about a part of the system that worker processes need and that is missing."""
    if settings.engine == "inline":
        return None
    if settings.scheduler is not None and settings.scheduler.endswith(":0"):
        return (
            f"PUGEO_SCHEDULER={settings.scheduler}: must be tls://host:port with the port that "
            "`pugeo scheduler` prints"
        )
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


def unusable_host(host: str, setting: str) -> str | None:
    """Return a line about an address that no program of this machine can listen on.

    Args:
        host: address or name.
        setting: its name, for the line.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except UnicodeError as error:
        reason = str(error)
    except OSError as error:
        unknown = isinstance(error, socket.gaierror)
        if not unknown and error.errno not in {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}:
            # What else is wrong is told where the service listens.
            return None
        reason = str(error.strerror)
    else:
        return None
    return f"{setting}={host}: must be an address or name of this machine ({reason})"
