# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.resample.overlap import PatchPoints, merge_overlapping


@pytest.fixture
def points():
    """Four corners of a unit square."""
    return np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])


def patch(points, rows, *, normal=(0.0, 0.0, 1.0), offcentre=0.5, normals=True):
    """Two samples a point: the point itself, and one 0.1 above it."""
    rows = np.array(rows, dtype=np.int32)
    samples = np.stack([points[rows], points[rows] + [0, 0, 0.1]], axis=1)
    each = np.tile(np.array(normal, dtype=np.float32), (len(rows), 2, 1))
    off = np.full(len(rows), offcentre, dtype=np.float32)
    if not normals:
        return PatchPoints(rows, samples, None, None, off)
    return PatchPoints(rows, samples, each, each[:, 0], off)


def test_farthest_samples_are_kept(points):
    """Four of eight samples: one of each corner, with its normal and its corner's row."""
    patches = [patch(points, [0, 1], normal=(1, 0, 0)), patch(points, [2, 3])]
    merged = merge_overlapping(points, np.ones(4, bool), patches, 4, keeps_input=False)
    assert sorted(merged.nearest) == [0, 1, 2, 3]
    assert (merged.error == 1).all()
    for row, normal in zip(merged.nearest, merged.normals, strict=True):
        assert tuple(normal) == ((1, 0, 0) if row < 2 else (0, 0, 1))


def test_samples_of_the_margin_are_left_out(points):
    """Only the core's points have samples in the output of a tile."""
    core = np.array([True, True, False, False])
    merged = merge_overlapping(points, core, [patch(points, [0, 1, 2, 3])], 3, keeps_input=False)
    assert set(merged.nearest) <= {0, 1}


def test_the_input_leads(points):
    """Kept points come first, unmoved, with the normal of the patch whose centre is nearest."""
    patches = [
        patch(points, [0, 1, 2, 3], normal=(0, 1, 0), offcentre=0.2),
        patch(points, [0, 1, 2, 3], normal=(1, 0, 0), offcentre=0.9),
    ]
    merged = merge_overlapping(points, np.ones(4, bool), patches, 6, keeps_input=True)
    np.testing.assert_array_equal(merged.points[:4], points)
    np.testing.assert_array_equal(merged.nearest[:4], np.arange(4))
    np.testing.assert_array_equal(merged.normals[:4], np.tile([0.0, 1, 0], (4, 1)))
    np.testing.assert_allclose(merged.points[4:, 2], 0.1)


def test_networks_without_normals_get_those_of_a_pca():
    """Samples on a plane: the normal is that of the plane."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.random((200, 2)), np.zeros((200, 1))], axis=1)
    rows = np.arange(200, dtype=np.int32)
    one = PatchPoints(rows, flat[:, None], None, None, np.zeros(200, dtype=np.float32))
    merged = merge_overlapping(flat, np.ones(200, bool), [one], 150, keeps_input=False)
    np.testing.assert_allclose(np.abs(merged.normals[:, 2]), 1.0, atol=1e-5)
