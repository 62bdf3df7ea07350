# SPDX-License-Identifier: Apache-2.0
"""The decorator of all kernels that are kept on disk.

A kernel that calls another one contains a copy of it, which numba optimised once more: the copy may
round otherwise than the kernel itself. numba leaves it to the order in which kernels are loaded
which of the two a call reaches: in a process that compiled them the other kernel, in one that read
them from disk the copy. Here it is always the copy, so that both give the same bytes.

For the same reason a stored kernel is outdated as soon as any module changed that its own imports:
it may contain code or constants of them. numba looks at its own module alone.
"""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import Linkage
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

from pugeo_model.kernel_sources import stamp

__all__ = ["njit"]


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator as ``numba.njit`` is; the code has copies of its own of what it calls."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(pipeline_class=_Compiler, **options)(function)
        if cache:
            kernel._cache = _Cache(function)  # noqa: SLF001 - numba has no other way
        return kernel

    return decorate


class _Cache(FunctionCache):
    """Stored code of a kernel, valid as long as none of its sources changed."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._file_name: str = self._impl.filename_base
        made_of = stamp(Path(function.__code__.co_filename))
        self._cache_file: Any = IndexDataCacheFile(self.cache_path, self._file_name, made_of)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store compiled code."""
        _drop_other_lines(Path(self.cache_path), self._file_name)
        super().save_overload(sig, data)  # type: ignore[no-untyped-call]


@functools.cache
def _drop_other_lines(folder: Path, name: str) -> None:
    """Delete what is stored of a kernel as it was when it stood at another line.

    numba replaces an outdated kernel, but its names are ``module.kernel-line.version``.
    """
    kernel, line = name.rsplit("-", 1)
    version = line.partition(".")[2]
    for path in folder.glob(f"{kernel}-*.{version}.*"):
        if not path.name.startswith(f"{name}."):
            # Someone else may delete it too, or not allow it.
            with contextlib.suppress(OSError):
                path.unlink()


class _Library(JITCodeLibrary):
    """Compiled code of a kernel; functions that were linked in are seen by no other code."""

    def _finalize_final_module(self) -> None:
        # Callers link this module in. There copies of one function are merged, as numba has it.
        shared = self._final_module.clone()
        for function in _defined(shared, Linkage.external):
            function.linkage = "linkonce_odr"
        self._shared_module = shared
        # All is optimised by now, so this decides on calls alone and changes no instruction.
        for function in _defined(self._final_module, Linkage.linkonce_odr):
            function.linkage = "internal"
        super()._finalize_final_module()  # type: ignore[no-untyped-call]


def _defined(module: Any, linkage: Linkage) -> list[Any]:
    """Functions that a module defines with a linkage."""
    return [
        each for each in module.functions if not each.is_declaration and each.linkage == linkage
    ]


class _Compiler(Compiler):
    """numba's compiler, which puts its code into a `_Library`."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        """Compile a function."""
        library: Any = _Library(self.state.targetctx.codegen(), func.__qualname__)  # type: ignore[no-untyped-call]
        library.enable_object_caching()
        self.state.library = library
        return super().compile_extra(func)  # type: ignore[no-untyped-call]
