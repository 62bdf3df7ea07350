# SPDX-License-Identifier: Apache-2.0
"""Real sensor files, through the service and the SDK."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_client import Client
from pugeo_model import Cloud
from pugeo_model.clean import clean
from pugeo_model.formats import read, write
from pugeo_model.geometry.neighbours import knn
from pugeo_model.geometry.neighbours import nearest as nearest_points
from pugeo_model.geometry.neighbours import spacing as mean_spacing
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.tuning import TUNING

_ROUNDING = 1e-6  # of coordinates, which are float32

SCANS = Path(__file__).resolve().parents[3] / "shared" / "scans"

pytestmark = pytest.mark.skipif(
    not SCANS.is_dir(), reason="the real scans lie beside the repository in ../shared/scans"
)


def kitti() -> Cloud:
    """A Velodyne frame: x, y, z in metres and reflectance."""
    raw = np.fromfile(SCANS / "kitti_000008.bin", dtype=np.float32).reshape(-1, 4)
    return Cloud(raw[:, :3].copy(), scalars={"intensity": raw[:, 3].copy()})


def laurana() -> Cloud:
    """A fifth of one view of a triangulation scanner, with a camera element and faces."""
    whole = whole_laurana()
    return whole.take(whole.points[:, 0] < np.quantile(whole.points[:, 0], 0.2))


def whole_laurana() -> Cloud:
    """The whole view."""
    return read(SCANS / "laurana_range_000.ply")


def autzen() -> Cloud:
    """Airborne LiDAR in projected coordinates, with colours and classes."""
    laspy: Any = pytest.importorskip("laspy", reason="LAS files need laspy")
    las = laspy.read(SCANS / "autzen_trim.las")
    return Cloud(
        np.stack([las.x, las.y, las.z], axis=1).astype(np.float64),
        colors=(np.stack([las.red, las.green, las.blue], axis=1) >> 8).astype(np.uint8),
        scalars={"classification": np.asarray(las.classification).astype(np.int32)},
    )


def office() -> Cloud:
    """A Kinect frame in which missing returns are NaN."""
    pypcd4: Any = pytest.importorskip("pypcd4", reason="PCD files need pypcd4")
    frame = pypcd4.PointCloud.from_path(SCANS / "office1.pcd")
    colors = pypcd4.PointCloud.decode_rgb(frame.pc_data["rgb"])
    return Cloud(frame.numpy(("x", "y", "z")).astype(np.float32), colors=colors.astype(np.uint8))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scan",
    [
        kitti,
        laurana,
        pytest.param(whole_laurana, marks=pytest.mark.long),
        pytest.param(autzen, marks=pytest.mark.long),
        pytest.param(office, marks=pytest.mark.long),
    ],
)
def test_eight_times_a_real_scan(inline: Any, tmp_path: Path, scan: Callable[[], Cloud]) -> None:
    """A scan comes back with exactly eight points for each that is left after cleaning."""
    cloud = scan()
    kept, dropped = clean(cloud)
    write(cloud, tmp_path / "scan.ply")
    # Not the service of most tests, which has limits below some scans.
    with Client(inline.url, timeout=580) as client:
        result = client.upsample(tmp_path / "scan.ply", ratio=8)
    assert result.points.shape == (8 * len(kept), 3)
    assert result.points.dtype == cloud.points.dtype
    assert result.meta.dropped == {
        "non_finite": dropped.non_finite,
        "duplicate": dropped.duplicate,
        "wild": dropped.wild,
    }
    assert np.isfinite(result.points).all()
    assert result.normals is not None
    np.testing.assert_allclose(np.linalg.norm(result.normals, axis=1), 1, atol=1e-4)
    assert (result.colors is None) == (cloud.colors is None)
    assert set(result.scalars) == set(cloud.scalars)
    # No outliers: dense points lie close to the nearest sparse point, in units of its spacing.
    tree = cKDTree(kept.points)
    spacing = knn(tree, kept.points, 9)[0][:, 1:].mean(axis=1)
    distance, nearest = knn(tree, result.points, 1)
    assert distance.max() < 1.3 * spacing.max()
    # Along a ring of a spinning scanner points are much closer than from ring to ring: the spacing
    # of the surface is that of the charts, and no point at all is further than the bound from one.
    plan = make_plan(cloud, Options(ratio=8.0))
    charts = plan.normalisation.world(plan.points).astype(np.float64)
    reach = TUNING.largest_offset * mean_spacing(nearest_points(plan.points)[0])
    near, which = knn(cKDTree(charts), result.points.astype(np.float64), 32)
    bound = reach[which] * plan.normalisation.scale + _ROUNDING * np.abs(charts).max()
    assert (near <= bound).any(axis=1).all()
    if scan is not kitti:
        assert (distance[:, 0] < 1.5 * spacing[nearest[:, 0]]).mean() > 0.99
