# SPDX-License-Identifier: Apache-2.0
"""One core and one thread: figures per core can be multiplied, figures per machine cannot."""

import os

__all__ = ["environment", "pin"]

# Whatever numpy, scipy, numba and torch may have been built with.
_COUNTS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def environment() -> dict[str, str]:
    """This process's environment with every thread count at 1, for a child process.

    Set before the child starts: libraries read these when they are loaded, and never again.
    """
    return {**os.environ, **dict.fromkeys(_COUNTS, "1")}


def pin(core: int | None) -> int | None:
    """Keep this process and its children on one core.

    Args:
        core: which one; the last that this process may use where ``None``.

    Returns:
        The core, or ``None`` where the system cannot pin (macOS, Windows).

    Raises:
        OSError: this process may not use that core.
    """
    if not hasattr(os, "sched_setaffinity"):
        return None
    chosen = max(os.sched_getaffinity(0)) if core is None else core
    os.sched_setaffinity(0, {chosen})
    return chosen
