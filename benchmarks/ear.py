# SPDX-License-Identifier: Apache-2.0
"""EAR, edge-aware resampling (Huang et al. 2013), by CGAL, for Table 1 of the paper.

    pip install cgal
    python -m benchmarks.ear SAMPLES reproduction
    pugeo reproduce --part comparison --networks reproduction ...

CGAL is under the GPL. No package of this project imports it, nor depends on it: this program
writes files, and the reproduction reads them.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read, write
from pugeo_model.options import Options
from pugeo_model.reproduce.stored import stored_path
from pugeo_model.reproduce.trained import RATIOS

__all__ = ["ear", "main"]

_NEIGHBOURS = 16  # of the normals, as the paper takes for methods without normals
_SHARPNESS = 25.0  # degrees between normals beyond which there is an edge: CGAL's default
_SENSITIVITY = 0.0  # towards edges: CGAL's default, even density
_REACH = 3.0  # mean spacings of the neighbourhood, as CGAL's manual advises


def ear(cloud: Cloud, ratio: float) -> Cloud:
    """Normals by a fitted quadric, given their signs over a spanning tree, then EAR.

    Args:
        cloud: the input, even.
        ratio: R; the result has exactly ``round(R M)`` points, the input's among them.

    Raises:
        ModuleNotFoundError: the package ``cgal`` is not installed.
    """
    from CGAL import CGAL_Point_set_processing_3 as processing
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3

    points = Point_set_3()
    for x, y, z in cloud.points.astype(np.float64).tolist():
        points.insert(Point_3(x, y, z))
    points.add_normal_map()
    processing.jet_estimate_normals(points, _NEIGHBOURS)
    processing.mst_orient_normals(points, _NEIGHBOURS)
    spacing = processing.compute_average_spacing(points, 6)
    wanted = Options(ratio).points_out(len(cloud))
    assert wanted is not None
    processing.edge_aware_upsample_point_set(
        points, _SHARPNESS, _SENSITIVITY, _REACH * spacing, wanted
    )
    rows = [(*_xyz(points.point(index)), *_xyz(points.normal(index))) for index in points.indices()]
    table = np.array(rows)
    lengths = np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    return Cloud(table[:, :3], normals=(table[:, 3:] / lengths).astype(np.float32))


def _xyz(vector: object) -> tuple[float, float, float]:
    return vector.x(), vector.y(), vector.z()  # type: ignore[attr-defined]


def main() -> None:
    """Write the dense clouds of all inputs and ratios."""
    parser = argparse.ArgumentParser(description="EAR of all NAME_5000.ply, for pugeo reproduce.")
    parser.add_argument("samples", type=Path, help="folder with inputs/NAME_5000.ply")
    parser.add_argument("networks", type=Path, help="folder that pugeo reproduce is given")
    parser.add_argument("--ratio", type=int, nargs="*", default=list(RATIOS))
    asked = parser.parse_args()
    for ratio in asked.ratio:
        folder = asked.networks / f"ear_x{ratio}"
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted((asked.samples / "inputs").glob("*_5000.ply")):
            cloud = read(path)
            begun = time.perf_counter()
            dense = ear(cloud, ratio)
            write(dense, stored_path(folder, cloud), format="ply")
            print(f"{path.stem} x{ratio}: {time.perf_counter() - begun:.1f} s")


if __name__ == "__main__":
    main()
