# SPDX-License-Identifier: Apache-2.0
"""The stage of a surface preview: bounds, normals, and clouds without a surface."""

import io
import sys
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.service.engine.standard import STANDARD

from pugeo_model import formats
from pugeo_model.cloud import Cloud
from pugeo_model.errors import UntreatableCloudError
from pugeo_service.engine import stages
from pugeo_service.engine.messages import RunRequest
from pugeo_service.runs import make_run_request
from pugeo_service.settings import Settings

_CENTRE = np.array([5e5, 4e6, 100.0])


def request(most: int) -> RunRequest:
    """A request for a surface of at most so many points."""
    return make_run_request(
        Settings(),
        {"ratio": 1.0},
        model=STANDARD,
        format=None,
        answer="ply",
        deadline_s=60.0,
        surface_points=most,
    )


def body(points: NDArray[np.float64], normals: NDArray[np.float32] | None) -> NDArray[np.uint8]:
    """Bytes of a cloud."""
    file = io.BytesIO()
    formats.write(Cloud(points, normals=normals), file, format="npz")
    return np.frombuffer(file.getvalue(), np.uint8)


def sphere(count: int) -> NDArray[np.float64]:
    """Points spread evenly on the unit sphere."""
    number = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * number / count), np.pi * (1 + 5**0.5) * number
    return np.stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1
    )


def mesh(output: Any, folder: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces of an answer."""
    path = folder / "mesh.ply"
    path.write_bytes(output.data.tobytes())
    vertices, faces = igl.read_triangle_mesh(str(path))
    return vertices, faces


@pytest.mark.parametrize("given", [True, False])
def test_a_georeferenced_sphere(tmp_path: Path, given: bool) -> None:
    """The mesh is the sphere at its place, with the file's normals and with the network's."""
    points = sphere(2000)
    data = body(points + _CENTRE, points.astype(np.float32) if given else None)
    output = stages.prepare(data, request(10_000)).output
    assert output is not None
    vertices, faces = mesh(output, tmp_path)
    assert np.abs(np.linalg.norm(vertices - _CENTRE, axis=1) - 1).max() < 0.02
    corner = vertices[faces] - _CENTRE
    volume = np.einsum("fc,fc->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert (output.report["points_in"], output.report["points_out"]) == (2000, 2000)
    assert (output.report["vertices"], output.report["faces"]) == (len(vertices), len(faces))


def test_larger_clouds_are_thinned() -> None:
    """No more points than allowed are used, the same ones each time."""
    points = sphere(3000)
    data = body(points, points.astype(np.float32))
    first, again = (stages.prepare(data, request(500)).output for _ in range(2))
    assert first is not None
    assert again is not None
    assert (first.report["points_in"], first.report["points_out"]) == (3000, 500)
    assert np.array_equal(first.data, again.data)


def test_normals_without_a_direction_come_from_the_network(tmp_path: Path) -> None:
    """Zero normals among the file's are replaced, so that they leave no dents."""
    points = sphere(2000)
    normals = points.astype(np.float32)
    normals[::3] = 0
    output = stages.prepare(body(points, normals), request(10_000)).output
    vertices, _ = mesh(output, tmp_path)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.02


def test_no_surface() -> None:
    """Points on a line are refused with the error that upsampling has for them."""
    line = np.outer(np.arange(50.0), [1.0, 2.0, 3.0])
    with pytest.raises(UntreatableCloudError, match="line"):
        stages.prepare(body(line, None), request(1000))


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing library is told before the work, with the extra to install."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ModuleNotFoundError, match="evaluate"):
        stages.prepare(body(sphere(100), None), request(1000))
