# SPDX-License-Identifier: Apache-2.0
"""Memory settings of the process: glibc's allocator and oneDNN's cache.

By default glibc returns every large block to the kernel and gets it back zeroed page by page: a
third of the time of the network and of a training step. Freed blocks are therefore kept during a
cloud and returned after it, since fragmentation would otherwise add up to gigabytes. oneDNN keeps
one compiled matrix product for each number of rows, by default 2 x 1024 of 0.3 MB each; a bound
keeps this small.
"""

import ctypes
import functools
import os
import sys
from typing import Any

__all__ = ["bound_compiled_products", "give_back_freed_memory", "keep_freed_memory"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEPT_BYTES = 1 << 26  # free bytes kept at the end of the heap: no layer needs more
_LARGEST_BLOCK = 1 << 30  # bytes; larger blocks are mapped separately

_COMPILED = "512"  # compiled products kept: several times the number that one large cloud needs
_CACHES = ("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "LRU_CACHE_CAPACITY")  # oneDNN's own, and torch's


def bound_compiled_products() -> None:
    """Limit the compiled products that torch keeps; no effect after the first product."""
    for name in _CACHES:
        os.environ.setdefault(name, _COMPILED)


@functools.cache
def keep_freed_memory() -> None:
    """Let the process keep up to 64 MiB of freed memory; does nothing without glibc."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_BLOCK)
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def give_back_freed_memory() -> None:
    """Return all free pages to the kernel (about 30 ms); does nothing without glibc."""
    if (libc := _glibc()) is not None:
        libc.malloc_trim(0)


@functools.cache
def _glibc() -> Any:
    if not sys.platform.startswith("linux"):
        return None
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, "malloc_trim") and hasattr(libc, "mallopt") else None
