# SPDX-License-Identifier: Apache-2.0
"""A small mesh, its samples and a small network."""

import numpy as np
import pytest

pytest.importorskip("igl", reason="training needs the train extra")

from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.run import load_shapes


@pytest.fixture(scope="session")
def small() -> Architecture:
    """A network that trains in seconds."""
    return Architecture(features=32, options=(("width", 16), ("edge_width", 16)))


@pytest.fixture(scope="session")
def meshes(tmp_path_factory: pytest.TempPathFactory):
    """A folder with a bumpy ball."""
    folder = tmp_path_factory.mktemp("meshes")
    rows, columns = 24, 48
    theta = np.linspace(0.05, np.pi - 0.05, rows)
    phi = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    r = 1 + 0.1 * np.sin(3 * p) * np.sin(t) ** 3
    points = np.stack([r * np.sin(t) * np.cos(p), r * np.sin(t) * np.sin(p), r * np.cos(t)], -1)
    lines = [f"OFF\n{rows * columns} {2 * (rows - 1) * columns} 0"]
    lines += [" ".join(f"{x:.6f}" for x in point) for point in points.reshape(-1, 3)]
    for i in range(rows - 1):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            lines += [f"3 {a} {a + columns} {b}", f"3 {b} {a + columns} {b + columns}"]
    (folder / "ball.off").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="session")
def shapes(meshes, tmp_path_factory: pytest.TempPathFactory):
    """The ball with its samples, cached in a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PUGEO_CACHE", str(tmp_path_factory.mktemp("cache")))
        return load_shapes(meshes)
