# SPDX-License-Identifier: Apache-2.0
"""Digests of what kernels are compiled from. Loads neither numba nor torch."""

import functools
import hashlib
import re
from importlib.metadata import version
from pathlib import Path

__all__ = ["modules_with_kernels", "sources", "stamp"]

_PACKAGE = Path(__file__).parent
_COMPILERS = ("llvmlite", "numba", "numpy")
_KERNEL = "\n@njit(cache=True"
# Imports at the top of a module, on one line or in parentheses.
_IMPORT = re.compile(r"^from (pugeo_model[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def modules_with_kernels(package: Path = _PACKAGE) -> list[Path]:
    """Modules whose kernels are stored."""
    return [path for path in sorted(package.rglob("*.py")) if _KERNEL in path.read_text("utf-8")]


@functools.cache
def stamp(*modules: Path, package: Path = _PACKAGE) -> str:
    """Digest of some modules, of all that they import, and of the versions of the compilers.

    The processor is no part of it: numba keeps the kernels of several beside each other.
    """
    digest = hashlib.sha256(_compilers().encode())
    for path in sorted(sources(*modules, package=package)):
        digest.update(f"\n{path.name} {_read(path)[0]}".encode())
    return digest.hexdigest()


def sources(*modules: Path, package: Path = _PACKAGE) -> set[Path]:
    """Some modules, and those of the package that they import, directly or not."""
    found: set[Path] = set()
    left = list(modules)
    while left:
        path = left.pop()
        if path not in found:
            found.add(path)
            files = (package.parent / name for name in _read(path)[1])
            left += [file for file in files if file not in found and file.exists()]
    return found


@functools.cache
def _compilers() -> str:
    """Versions of what compiles kernels."""
    return " ".join(f"{name} {version(name)}" for name in _COMPILERS)


@functools.cache
def _read(path: Path) -> tuple[str, frozenset[str]]:
    """Digest of a module, and files that its imports may name, from the parent of the package."""
    content = path.read_bytes()
    named = set()
    for module, names in _IMPORT.findall(content.decode()):
        for each in (module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))):
            file = each.replace(".", "/")
            named |= {f"{file}.py", f"{file}/__init__.py"}
    return hashlib.sha256(content).hexdigest(), frozenset(named)
