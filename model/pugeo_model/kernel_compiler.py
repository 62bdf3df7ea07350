# SPDX-License-Identifier: Apache-2.0
"""The decorator of all kernels that are kept on disk.

A kernel that calls another one contains a copy of it, which numba optimised once more: the copy may
round otherwise than the kernel itself. numba leaves it to the order in which kernels are loaded
which of the two a call reaches: in a process that compiled them the other kernel, in one that read
them from disk the copy. Here it is always the copy, so that both give the same bytes.
"""

from collections.abc import Callable
from typing import Any

import numba
from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

__all__ = ["njit"]


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator as ``numba.njit`` is; the code has copies of its own of what it calls."""
    decorator: Callable[[Callable[..., Any]], Any] = numba.njit(pipeline_class=_Compiler, **options)
    return decorator


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
