# SPDX-License-Identifier: Apache-2.0
"""Freed memory is kept for the next layer.

By default glibc hands every large block back to the kernel and fetches it anew, zeroed page by
page: a third of the time of the network and of a training step.
"""

import ctypes
import functools
import sys

__all__ = ["keep_freed_memory"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEPT = 1 << 28  # bytes at the end of the heap that stay with the process: no layer needs more
_LARGEST = 1 << 30


@functools.cache
def keep_freed_memory() -> None:
    """Let the process keep up to 256 MiB that it has freed; does nothing without glibc."""
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return
    mallopt(_M_MMAP_THRESHOLD, _LARGEST)
    mallopt(_M_TRIM_THRESHOLD, _KEPT)
