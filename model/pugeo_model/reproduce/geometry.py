# SPDX-License-Identifier: Apache-2.0
"""The paper's last figure: do T and the displacement mean what the theory of surfaces says?"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.network.local_surface import LocalSurfaces, patch_surfaces, tile_surfaces
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.prepare import prepare
from pugeo_model.reproduce.solids import Solid, cube, sphere
from pugeo_model.weights import load

__all__ = ["Findings", "draw_histograms", "local_surfaces", "verify"]

_EDGE = 2.0  # spacings from an edge within which a point of the cube counts as on it


@dataclass(frozen=True, eq=False)
class Findings:
    """Measurements on one solid, pooled over all points.

    Attributes:
        name: of the solid.
        axis_angle: ``(n,)`` degrees between ``t3`` and ``t1 x t2``.
        displacement: ``(n * R,)`` in spacings of the points.
        normal_angle: ``(n,)`` degrees between ``t3`` and the true normal.
        curvature: ``(n, 2)`` predicted principal curvatures, sign as the true normal, times the
            radius 1/2 on the sphere; true are -1 there and 0 on faces of the cube.
        stretch: ``(n, 2)`` principal stretches of ``(u, v)``, the roots of the eigenvalues of the
            first fundamental form; one where T is a rotation.
        metric_error: ``(n,)`` ``|I - I*| / |I*|`` (Frobenius) with ``I*`` the first fundamental
            form of the true surface, its points reached from the same ``x + T (u, v, 0)``.
        near_edge: ``(n,)`` the point is near an edge.
    """

    name: str
    axis_angle: NDArray[np.float64]
    displacement: NDArray[np.float64]
    normal_angle: NDArray[np.float64]
    curvature: NDArray[np.float64]
    stretch: NDArray[np.float64]
    metric_error: NDArray[np.float64]
    near_edge: NDArray[np.bool_]

    def numbers(self) -> dict[str, float]:
        """The numbers that the text of the figure reports."""
        inner = ~self.near_edge
        displacement = np.abs(self.displacement).reshape(len(inner), -1)
        return {
            "angle median": float(np.median(self.axis_angle)),
            "angle below 3°, %": 100.0 * float((self.axis_angle < 3.0).mean()),
            "normal off, mean °": float(self.normal_angle.mean()),
            "delta mean, spacings": float(displacement.mean()),
            "delta 95 %, spacings": float(np.quantile(displacement, 0.95)),
            "delta mean off edges": float(displacement[inner].mean()),
            "curvature mean (x r)": float(self.curvature[inner].mean()),
            "curvature std (x r)": float(self.curvature[inner].std()),
            "stretch mean": float(self.stretch.mean()),
            "stretch std": float(self.stretch.std()),
            "metric off, %": 100.0 * float(self.metric_error[inner].mean()),
        }


def local_surfaces(weights: str | Path, points: NDArray[np.float64], ratio: int) -> LocalSurfaces:
    """Local surfaces of any network that has them, each point in one patch at least.

    Raises:
        ValueError: the network does not predict ``T``.
    """
    model: Any = load(weights)
    plan = make_plan(
        Cloud(points), Options(1.0), tile_size=len(points), patch_ratio=model.patch_ratio
    )
    job = prepare(plan.tile(0))
    if model.patch_ratio is None:
        parts = [tile_surfaces(model.net, patch, ratio) for patch in job.patches]
    elif getattr(model.net, "T", None) is None:
        raise ValueError(f"{weights} predicts no T")
    else:
        parts = [patch_surfaces(model.net, patch) for patch in job.patches]
    names = [field for field in LocalSurfaces.__dataclass_fields__ if field != "rows"]
    scale = plan.normalisation.scale
    rows = np.concatenate([job.order[part.rows] for part in parts])
    found = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
    # T and first derivatives have no unit; second derivatives are per length.
    found["displacement"] = found["displacement"] * scale
    found["samples"] = found["samples"] * scale
    for name in ("Y_uu", "Y_uv", "Y_vv"):
        found[name] = found[name] / scale
    return LocalSurfaces(rows=rows, **found)


def verify(weights: str | Path, ratio: int, count: int = 5000) -> Iterator[Findings]:
    """Findings on the sphere and on the cube, ``count`` even points each."""
    for make in (sphere, cube):
        yield _findings(make(count), lambda points: local_surfaces(weights, points, ratio))


def _findings(solid: Solid, predict: Callable[[NDArray[np.float64]], LocalSurfaces]) -> Findings:
    found = predict(solid.points)
    area = 6.0 if solid.name == "cube" else np.pi
    spacing = float(np.sqrt(area / len(solid.points)))
    t3, true = found.T[:, :, 2], solid.normals[found.rows]
    sine = np.linalg.norm(np.cross(t3, true), axis=1)
    angle = np.degrees(np.arctan2(sine, np.abs((t3 * true).sum(axis=1))))
    side = np.sign((np.cross(found.Y_u, found.Y_v) * true).sum(axis=1))
    stretch = np.sqrt(np.maximum(np.linalg.eigvalsh(found.first_form), 0.0))
    return Findings(
        solid.name,
        found.axis_angle,
        (found.displacement / spacing).ravel(),
        angle,
        0.5 * side[:, None] * found.principal_curvatures,
        stretch,
        _metric_error(found, true),
        solid.flat[found.rows] < _EDGE * spacing,
    )


def _metric_error(found: LocalSurfaces, true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Relative error of the first fundamental form at the points themselves, ``(n,)``.

    Along ``t3`` the true surface is met at ``x + t_j du + a_j t3 du`` with
    ``(t_j + a_j t3) . n = 0``.
    """
    t3 = found.T[:, :, 2]
    tangents = found.T[:, :, :2]
    along = np.einsum("nab,na->nb", tangents, true) / (t3 * true).sum(axis=1)[:, None]
    met = tangents - along[:, None, :] * t3[:, :, None]
    wanted = np.swapaxes(met, 1, 2) @ met
    off = np.linalg.norm(found.first_form - wanted, axis=(1, 2))
    error: NDArray[np.float64] = off / np.linalg.norm(wanted, axis=(1, 2))
    return error


def draw_histograms(findings: Sequence[Findings], target: Path) -> None:
    """Draw angle, displacement and curvature, a row for each solid."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(findings), 3, figsize=(12, 3.2 * len(findings)), layout="constrained", squeeze=False
    )
    for row, found in zip(axes, findings, strict=True):
        inner = ~found.near_edge
        row[0].hist(np.minimum(found.axis_angle, 15.0), bins=60)
        row[0].set(xlabel="angle of t3 and t1 x t2, degrees", ylabel=found.name)
        row[1].hist(np.clip(found.displacement, -0.5, 0.5), bins=80)
        row[1].set(xlabel="displacement, spacings", yscale="log")
        row[2].hist(np.clip(found.curvature[inner].ravel(), -4.0, 4.0), bins=80)
        row[2].axvline(-1.0 if found.name == "sphere" else 0.0, color="black", linestyle=":")
        row[2].set(xlabel="principal curvatures x radius (dotted: true)")
    figure.savefig(target, dpi=110)
    plt.close(figure)
