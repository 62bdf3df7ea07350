# SPDX-License-Identifier: Apache-2.0
"""Delete what the service never loads from an installed environment.

    python deploy/image/prune.py /opt/venv

Tests, headers and test programs of libraries are a fifth of the image. The build compiles the
kernels afterwards, and the test of the image upsamples a cloud, so that a file too many is noticed.
"""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

# Beside every folder `tests`; `torch/bin/torch_shm_manager` is a program that torch runs.
_UNUSED = (
    "numba/cuda",
    "torch/bin/[!t]*",
    "torch/bin/test_*",
    "torch/include",
    "torch/lib/*test*.so",
    "torch/share",
    "torch/test",
)


def unused(packages: Path) -> Iterator[Path]:
    """Yield files and folders below a folder ``site-packages`` that the service never loads."""
    for pattern in _UNUSED:
        yield from packages.glob(pattern)
    # Folders of libraries that import their own tests have another name.
    yield from (path for path in packages.glob("*/**/tests") if path.is_dir())


def size(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file())


def main(environment: Path) -> None:
    """Delete from each ``site-packages`` of the environment and print the bytes."""
    (packages,) = environment.glob("lib/python3*/site-packages")
    deleted = 0
    for path in sorted(unused(packages)):
        if path.exists():  # not within a folder that is gone already
            deleted += size(path)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    sys.stdout.write(f"deleted {deleted / 1e6:.0f} MB of tests, headers and test programs\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
