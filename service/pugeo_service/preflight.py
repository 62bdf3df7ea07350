# SPDX-License-Identifier: Apache-2.0
"""Checks of the machine and of the weights before anything starts.

Without them the same faults end worker processes, one traceback each, while the front waits.
"""

import multiprocessing
import subprocess
import sys
from pathlib import Path

from pugeo_model import weights
from pugeo_model.errors import CloudError
from pugeo_service.settings import Settings

__all__ = ["unfit_machine", "unfit_weights"]

_LOAD = "import sys; from pugeo_model.weights import load_or_explain; load_or_explain(sys.argv[1])"
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


def unfit_weights(settings: Settings) -> str | None:
    """Return a line about weights that cannot be used, or ``None``.

    Released weights are compared with their sha256. Weights of a path are also loaded once, in a
    process that ends again, because this one must stay free of torch.
    """
    try:
        card = weights.read_card(settings.model)
    except CloudError as error:
        return f"PUGEO_MODEL={settings.model}: {error.message}"
    missing = [name for name in ("name", "version") if name not in card]
    if missing:
        return f"PUGEO_MODEL={settings.model}: the card of the weights has no {', '.join(missing)}"
    if settings.model in weights.available():
        return None
    command = [sys.executable, "-c", _LOAD, settings.model]
    loaded = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603
    if loaded.returncode == 0:
        return None
    last = (loaded.stderr.strip().splitlines() or ["the process ended"])[-1]
    return f"PUGEO_MODEL={settings.model}: {last}"
