# SPDX-License-Identifier: Apache-2.0
"""Cache of compiled kernels: a writable folder, and one compilation for all workers.

numba stores compiled kernels beside each module or, if that folder is read-only, in the user's
cache folder. `use_writable_folder` adds a third place. Kernels of other sources are compiled anew,
see `kernel_compiler`. This module imports neither numba nor torch.
"""

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pugeo_model.kernel_sources import modules_with_kernels, stamp

__all__ = ["compile_kernels", "compiled", "use_writable_folder"]

_PACKAGE = Path(__file__).parent
_FOLDER_VARIABLE = "NUMBA_CACHE_DIR"
_COMPILE = "from pugeo_model.kernel_cache import _compile_here; _compile_here()"


def use_writable_folder() -> None:
    """Let numba store kernels in a writable folder.

    Must be called before numba is imported. A writable folder in ``NUMBA_CACHE_DIR`` is used.
    """
    chosen = os.environ.get(_FOLDER_VARIABLE)
    if chosen and _is_writable(Path(chosen)):
        return
    if not chosen and _is_writable(_PACKAGE) and _is_writable(_PACKAGE / "__pycache__"):
        return
    if chosen or not _is_writable(_user_folder()):
        os.environ[_FOLDER_VARIABLE] = str(_temporary_folder())


def compiled() -> bool:
    """Return whether all kernels of this version were compiled for this machine."""
    return _marker().exists()


def compile_kernels(
    announce: Callable[[str], object],
    started: Callable[["subprocess.Popen[str]"], object] = lambda _: None,
) -> None:
    """Compile all kernels in a separate process, unless they are compiled.

    Args:
        announce: called with a message before and after the compilation.
        started: called with the process, for a caller that may have to end it.

    Raises:
        RuntimeError: the process failed; the message ends with its last line.
    """
    if compiled():
        return
    announce("compiling kernels for this machine; this happens once and takes a minute or two ...")
    start = time.perf_counter()
    with subprocess.Popen(  # noqa: S603 - our own interpreter and code
        [sys.executable, "-c", _COMPILE],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl+C reaches the whole process group; the traceback of this one would tell nobody.
        start_new_session=True,
    ) as process:
        started(process)
        try:
            errors = process.communicate()[1]
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        last = (errors.strip().splitlines() or ["the process was ended"])[-1]
        raise RuntimeError(f"kernels could not be compiled: {last[-500:]}")
    announce(f"compiled kernels in {time.perf_counter() - start:.0f} s")


def _compile_here() -> None:
    """Upsample small clouds so that all kernels of an upsampling are compiled and stored."""
    import numpy as np

    from pugeo_model.cloud import Cloud
    from pugeo_model.options import Options
    from pugeo_model.plan import make_plan
    from pugeo_model.upsampler import Upsampler

    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    upsampler = Upsampler()
    upsampler(Cloud(points), ratio=2.0)
    upsampler(Cloud(points[:600] + rng.normal(size=(600, 3), scale=0.02)), ratio=8.0)
    # Several tiles, in which charts stand for many points each.
    x, y, _ = np.indices((30, 30, 6)).reshape(3, -1)
    frames = np.stack([x, y, rng.normal(size=len(x), scale=0.3)], axis=-1)
    upsampler.upsample(make_plan(Cloud(frames), Options(2.0), tile_size=400))
    _mark_compiled()


def _mark_compiled() -> None:
    """Write the marker, and delete those of other sources."""
    marker = _marker()
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()
    for other in marker.parent.glob(f"compiled-{_place()}-*"):
        # Those of other processors stay: their kernels are in the same folder.
        if _sources() not in other.name:
            other.unlink(missing_ok=True)


def _marker() -> Path:
    """File that exists once the kernels of these sources were compiled for this machine."""
    machine = hashlib.sha256(f"{sys.version} {_processor()}".encode()).hexdigest()
    return _folder() / f"compiled-{_place()}-{_sources()}-{machine[:16]}"


def _sources() -> str:
    """Short digest of the sources of all kernels."""
    return stamp(*modules_with_kernels())[:16]


def _place() -> str:
    """Short digest of where the package is installed; kernels are stored by that too."""
    return hashlib.sha256(os.fsencode(_PACKAGE)).hexdigest()[:8]


def _folder() -> Path:
    """Folder of the marker: that of the kernels or next to it."""
    if folder := os.environ.get(_FOLDER_VARIABLE):
        return Path(folder)
    return _PACKAGE / "__pycache__" if _is_writable(_PACKAGE) else _user_folder() / "pugeo"


def _user_folder() -> Path:
    """Cache folder of the user, which may not exist."""
    try:
        home = Path.home()
    except RuntimeError:  # no HOME, and no entry for this user
        home = Path("/nonexistent")
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _temporary_folder() -> Path:
    """A temporary folder that only this user can write, since its content is executed."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    folder = Path(tempfile.gettempdir()) / f"pugeo-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        owned = not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid()
    except OSError:
        owned = False
    if owned and not folder.is_symlink():
        return folder
    return Path(tempfile.mkdtemp(prefix="pugeo-kernels-"))


def _is_writable(folder: Path) -> bool:
    """Return whether files can be created in a folder, or the folder itself can be created."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK)


def _processor() -> str:
    """Name and instruction sets of the processor, which kernels depend on."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    names = [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    return "\n".join(names[:2]) or platform.processor()
