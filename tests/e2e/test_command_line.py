# SPDX-License-Identifier: Apache-2.0
"""``pugeo upsample --url`` on a real service."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud
from pugeo_model.formats import read, write


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str


@pytest.fixture
def environment(root: Path, tmp_path: Path) -> dict[str, str]:
    """The environment with the entry points of this checkout, installed or not."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    lines = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    made = tmp_path / "site" / "pugeo_checkout-0.dist-info"
    made.mkdir(parents=True)
    (made / "entry_points.txt").write_text("\n".join(lines))
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: pugeo-checkout\nVersion: 0\n")
    path = os.pathsep.join([str(made.parent), *sys.path])
    return {**os.environ, "PYTHONPATH": path}


@pytest.mark.slow
@pytest.mark.parametrize("how", [[], ["--jobs"]])
def test_a_folder_on_a_service(
    server: Server,
    environment: dict[str, str],
    sphere: NDArray[np.float32],
    tmp_path: Path,
    how: list[str],
) -> None:
    """A folder is upsampled by the service, each file in its format; one bad file is named."""
    (tmp_path / "scans").mkdir()
    for name in ("a.laz", "b.ply", "c.npz"):
        write(Cloud(sphere.astype(np.float64)), tmp_path / "scans" / name)
    (tmp_path / "scans" / "bad.laz").write_bytes((tmp_path / "scans/a.laz").read_bytes()[:400])
    command = [sys.executable, "-c", "from pugeo_model.cli import main; main()"]
    command += ["upsample", "scans", "-o", "dense/", "-R", "2", "--url", server.url, *how]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 3, done.stderr
    assert "3 written, 0 skipped, 1 failed: 3,600 points" in done.stderr
    assert "error: scans/bad.laz (laz): " in done.stderr
    for name in ("a.laz", "b.ply", "c.npz"):
        dense = read(tmp_path / "dense" / name)
        assert len(dense) == 1200
        assert dense.source is not None
        assert dense.source.format == name.partition(".")[2]
