# SPDX-License-Identifier: Apache-2.0
"""Pictures of real scans and their answers: ``python -m benchmarks.scan_pictures FILE... PNG``.

Of each file a part is upsampled fourfold and drawn below its input, lit by the predicted normals.
The kind of sensor is told by the format: PCD is a depth camera that looks along z, LAS an airborne
scan, and BIN a frame of a spinning scanner as KITTI has them.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read
from pugeo_model.reproduce.robustness import Shown, draw, lidar
from pugeo_model.upsampler import Upsampler

__all__: list[str] = []

_RATIO = 4.0
_CAMERA = np.diag([1.0, -1.0, -1.0])  # x right, y down, z ahead; pictures look along -z, y is up
_FROM_ABOVE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SIDE = 0.4  # of the longest side of a scan: the part that is drawn, around its middle


def _part(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points around the median of a scan."""
    points = points[np.isfinite(points).all(axis=1)]
    half = _SIDE / 2.0 * np.ptp(points, axis=0).max()
    around = np.abs(points - np.median(points, axis=0)) < half
    part: NDArray[np.float64] = points[around.all(axis=1)]
    return part


def _depth_camera(upsampler: Upsampler, file: Path) -> Shown:
    part = _part(read(file).points.astype(np.float64))
    dense = upsampler(Cloud(part), _RATIO, viewpoint=(0.0, 0.0, 0.0)).cloud
    return Shown("depth camera", Cloud(part), dense, _CAMERA, {})


def _airborne(upsampler: Upsampler, file: Path) -> Shown:
    part = _part(read(file).points.astype(np.float64))
    above = (*np.median(part, axis=0)[:2], part[:, 2].max() + 10.0 * np.ptp(part))
    dense = upsampler(Cloud(part), _RATIO, viewpoint=above).cloud
    return Shown("airborne", Cloud(part), dense, _FROM_ABOVE, {})


def _rings(upsampler: Upsampler, file: Path) -> Shown:
    return lidar(lambda cloud, _: upsampler(cloud, _RATIO, viewpoint=(0.0, 0.0, 0.0)).cloud, file)


_KINDS: dict[str, Callable[[Upsampler, Path], Shown]] = {
    ".pcd": _depth_camera,
    ".las": _airborne,
    ".bin": _rings,
}


def main() -> None:
    """Draw the picture, and print the seconds of each answer."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("picture", type=Path)
    chosen = parser.parse_args()
    upsampler, shown = Upsampler(), []
    for file in chosen.files:
        started = time.perf_counter()
        shown.append(_KINDS[file.suffix](upsampler, file))
        seconds = time.perf_counter() - started
        print(f"{shown[-1].name}: {len(shown[-1].sparse):,} points in, {seconds:.1f} s", flush=True)
    draw(shown, chosen.picture, pixels=600)


if __name__ == "__main__":
    main()
