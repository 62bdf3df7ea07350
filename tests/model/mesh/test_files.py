# SPDX-License-Identifier: Apache-2.0
"""Files of meshes: double precision, and whole or not at all."""

from pathlib import Path

import numpy as np
import pytest

from pugeo_model.mesh.files import read_mesh, unit_size, write_mesh

VERTICES = np.array(
    [[500_000.123456, 5_400_000.654321, 300], [500_001, 5_400_000, 301], [5e5, 0, 3]]
)
FACES = np.array([[0, 1, 2]])


def test_round_trip(tmp_path: Path) -> None:
    """Large coordinates come back bit for bit; an older file is replaced and nothing else stays."""
    path = tmp_path / "mesh.ply"
    path.write_text("old")
    write_mesh(VERTICES, FACES, path)
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, VERTICES)
    np.testing.assert_array_equal(faces, FACES)
    assert list(tmp_path.iterdir()) == [path]


def test_a_descriptor_is_written_and_not_replaced(tmp_path: Path) -> None:
    """A file that others append to (``>> log``) gets the mesh at its end."""
    log = tmp_path / "log"
    log.write_bytes(b"old")
    inode = log.stat().st_ino
    with log.open("ab") as opened:
        if not Path(f"/dev/fd/{opened.fileno()}").exists():
            pytest.skip("needs /dev/fd")
        write_mesh(VERTICES, FACES, Path(f"/dev/fd/{opened.fileno()}"))
    assert log.read_bytes().startswith(b"oldply")
    assert log.stat().st_ino == inode
    assert list(tmp_path.iterdir()) == [log]


def test_no_folder(tmp_path: Path) -> None:
    """A folder that is missing is an error of the system."""
    with pytest.raises(FileNotFoundError):
        write_mesh(VERTICES, FACES, tmp_path / "none" / "mesh.ply")


def test_unit_size() -> None:
    """The longest side becomes 1, around the origin."""
    scaled = unit_size(VERTICES)
    assert np.ptp(scaled, axis=0).max() == pytest.approx(1.0)
    np.testing.assert_allclose(scaled.min(axis=0) + scaled.max(axis=0), 0, atol=1e-12)
