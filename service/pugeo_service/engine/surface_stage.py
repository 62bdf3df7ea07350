# SPDX-License-Identifier: Apache-2.0
"""The stage of a preview: the surface of a cloud as a mesh, in one task on one worker."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from pugeo_service.engine.values import Output, Prepared

if TYPE_CHECKING:
    from pugeo_model.cloud import Cloud
    from pugeo_model.local_stages import Network
    from pugeo_model.stage_times import StageTimes

__all__ = ["make_surface"]


def make_surface(cloud: Cloud, most: int, model: Network, times: StageTimes) -> Prepared:
    """Reconstruct the surface of a cloud.

    The number of points bounds time and memory, so a larger cloud is thinned at random, the same
    each time. Points without normals get them from the network.

    Args:
        cloud: as it was read.
        most: points that the surface is made of, at most.
        model: the loaded network.
        times: gets the seconds of the stages, and has those so far.

    Returns:
        An answer whose bytes are a binary PLY file with faces, in the frame of the cloud; its
        report has ``points_out``, the points that the surface is made of.

    Raises:
        CloudError: the points span no surface.
        ModuleNotFoundError: the library of the reconstruction is not installed.
    """
    import numpy as np

    from pugeo_model.errors import UntreatableCloudError
    from pugeo_model.local_stages import LocalStages
    from pugeo_model.mesh.files import write_mesh
    from pugeo_model.metrics.reconstruction import library
    from pugeo_model.metrics.surface import surface_of
    from pugeo_model.options import Options
    from pugeo_model.pipeline import run_here, upsample_tile
    from pugeo_model.plan import make_plan

    library()  # before the work
    read = len(cloud)
    if read > most:
        rows = np.random.default_rng(0).choice(read, most, replace=False)
        cloud = cloud.take(np.sort(rows))
    with times.measure("prepare"):
        plan = make_plan(cloud, Options(ratio=1.0), patch_ratio=model.patch_ratio)
    stages = LocalStages(model, lambda _stage, _share: None)
    stages.times.add(times.seconds)
    oriented = plan.cloud
    if oriented.normals is None or plan.orient != "input" or not oriented.normals.any(1).all():
        from pugeo_model.assembly import assemble

        tiles = [run_here(upsample_tile(stages, tile)) for tile in plan.tiles]
        oriented = assemble(plan, tiles).cloud
    with stages.times.measure("surface"), tempfile.TemporaryDirectory() as folder:
        try:
            vertices, faces = surface_of(oriented)
        except RuntimeError as error:
            raise UntreatableCloudError(f"No surface was found: {error}.") from error
        path = Path(folder) / "surface.ply"
        write_mesh(vertices, faces, path)
        data = np.fromfile(path, np.uint8)
    report = {**plan.report, "points_in": read, "vertices": len(vertices), "faces": len(faces)}
    return Prepared(
        plan, None, {}, output=Output(data, report, stages.times.seconds, stages.batches)
    )
