# SPDX-License-Identifier: Apache-2.0
"""Freed memory is kept for the next layer, and given back when a cloud is done.

By default glibc hands every large block back to the kernel and fetches it anew, zeroed page by
page: a third of the time of the network and of a training step. Kept for long, though, blocks of
all sizes between what lives on add up to gigabytes. So do the products that torch has compiled, one
for every number of rows: by default it keeps 2 x 1024 of them, 0.3 MB each.
"""

import ctypes
import functools
import os
import sys
from typing import Any

__all__ = ["give_back_freed_memory", "keep_freed_memory"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEPT = 1 << 26  # bytes at the end of the heap that stay with the process: no layer needs more
_LARGEST = 1 << 30

_COMPILED = "512"  # several times what one large cloud needs
_CACHES = ("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "LRU_CACHE_CAPACITY")  # of oneDNN, of torch's use


def bound_compiled_products() -> None:
    """Let torch keep fewer compiled products; does nothing once the first was made."""
    for name in _CACHES:
        os.environ.setdefault(name, _COMPILED)


@functools.cache
def keep_freed_memory() -> None:
    """Let the process keep up to 64 MiB that it has freed; does nothing without glibc."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST)
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT)


def give_back_freed_memory() -> None:
    """Hand every free page back to the kernel: some 30 ms; does nothing without glibc."""
    if (libc := _glibc()) is not None:
        libc.malloc_trim(0)


@functools.cache
def _glibc() -> Any:
    if not sys.platform.startswith("linux"):
        return None
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, "malloc_trim") and hasattr(libc, "mallopt") else None
