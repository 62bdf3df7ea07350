# SPDX-License-Identifier: Apache-2.0
"""Training shapes and their cache."""

from pathlib import Path

import numpy as np
import pytest

from pugeo_model.mesh.files import mesh_files
from pugeo_model.training import corpus
from pugeo_model.training.corpus import content_hash, default_cache, load_shape


def test_a_shape_has_longest_side_one(shapes):
    """Vertices are centred and scaled; samples of all sizes lie in their bounding box."""
    (shape,) = shapes
    assert shape.name == "ball"
    assert np.ptp(shape.vertices, axis=0).max() == pytest.approx(1.0, abs=1e-6)
    assert [len(points) for points in shape.inputs] == list(corpus.SIZES)
    for points in (shape.pool, *shape.inputs):
        assert np.abs(points).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1.0)


def test_samples_are_cached_by_content(meshes, tmp_path, monkeypatch):
    """A second load samples nothing; a changed mesh of the same name is sampled again."""
    cache = tmp_path / "cache"
    first = load_shape(mesh_files(meshes)[0], cache)
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr(corpus, "poisson_disk", lambda *_: pytest.fail("sampled again"))
    again = load_shape(mesh_files(meshes)[0], cache)
    np.testing.assert_array_equal(first.pool, again.pool)
    changed = tmp_path / "ball.off"
    changed.write_text(mesh_files(meshes)[0].read_text().replace("0.9", "0.8"))
    with pytest.raises(pytest.fail.Exception, match="sampled again"):
        load_shape(changed, cache)


def test_an_empty_folder_is_an_error(tmp_path):
    """A folder without meshes is an error that names the folder."""
    (tmp_path / "notes.txt").write_text("no mesh")
    with pytest.raises(FileNotFoundError, match="no mesh") as caught:
        mesh_files(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_meshes_are_sorted_by_name(tmp_path):
    """Files of the known formats are found, in any case, in the order of their names."""
    for name in ("b.PLY", "a.obj", "c.stl", "d.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in mesh_files(tmp_path)] == ["a.obj", "b.PLY", "c.stl"]


def test_the_content_hash(tmp_path):
    """It depends on names and contents."""
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    one.write_text("same")
    two.write_text("same")
    before = content_hash([one])
    assert before == content_hash([one]) != content_hash([two])
    one.write_text("other")
    assert content_hash([one]) != before


def test_the_cache_folder(monkeypatch, tmp_path):
    """``PUGEO_CACHE`` comes first, then ``XDG_CACHE_HOME``, then the home folder."""
    monkeypatch.setenv("PUGEO_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_cache() == tmp_path / "own"
    monkeypatch.delenv("PUGEO_CACHE")
    assert default_cache() == tmp_path / "xdg" / "pugeo"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache() == Path.home() / ".cache" / "pugeo"
