# SPDX-License-Identifier: Apache-2.0
"""The local surfaces that networks learned, as parametric surfaces to be differentiated.

Both kinds of network give ``Y_i(u, v) = x_i + T_i (u, v, delta_i(u, v))`` at every point. Its first
and second derivatives at (0, 0), by central differences, give the fundamental forms.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pugeo_model.network.patch_networks.pugeo_net import PUGeoNetPaper, principal_axes

__all__ = ["LocalSurfaces", "patch_surfaces", "tile_surfaces"]

_STEP = 0.25  # of the differences, in spacings: a quarter of the way to a neighbour


@dataclass(frozen=True, eq=False)
class LocalSurfaces:
    """The predicted surface around ``n`` points, in the unit of the cloud.

    Attributes:
        rows: ``(n,)`` int32 rows of the cloud.
        T: ``(n, 3, 3)`` float64, columns ``t1, t2, t3``.
        displacement: ``(n, R)`` float64 along the unit normal ``t3 / |t3|``, of the samples.
        samples: ``(n, R, 2)`` float64 (u, v).
        Y_u, Y_v: ``(n, 3)`` first derivatives at (0, 0).
        Y_uu, Y_uv, Y_vv: ``(n, 3)`` second derivatives.
    """

    rows: NDArray[np.int32]
    T: NDArray[np.float64]
    displacement: NDArray[np.float64]
    samples: NDArray[np.float64]
    Y_u: NDArray[np.float64]
    Y_v: NDArray[np.float64]
    Y_uu: NDArray[np.float64]
    Y_uv: NDArray[np.float64]
    Y_vv: NDArray[np.float64]

    @property
    def first_form(self) -> NDArray[np.float64]:
        """First fundamental form ``(n, 2, 2)``: ``E, F, G`` of the parameterization."""
        E = (self.Y_u * self.Y_u).sum(-1)
        F = (self.Y_u * self.Y_v).sum(-1)
        G = (self.Y_v * self.Y_v).sum(-1)
        return np.stack([np.stack([E, F], -1), np.stack([F, G], -1)], -2)

    @property
    def principal_curvatures(self) -> NDArray[np.float64]:
        """Eigenvalues of ``I^-1 II``, ``(n, 2)`` ascending; signs as the normal ``Y_u x Y_v``."""
        normal = np.cross(self.Y_u, self.Y_v)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        L, M, N = ((second * normal).sum(-1) for second in (self.Y_uu, self.Y_uv, self.Y_vv))
        second_form = np.stack([np.stack([L, M], -1), np.stack([M, N], -1)], -2)
        # Symmetric where (u, v) are stretched to unit length: I = C C^T.
        inverse = np.linalg.inv(np.linalg.cholesky(self.first_form))
        shape = inverse @ second_form @ np.swapaxes(inverse, -1, -2)
        curvatures: NDArray[np.float64] = np.linalg.eigvalsh(shape)
        return curvatures

    @property
    def axis_angle(self) -> NDArray[np.float64]:
        """Angle between ``t3`` and ``t1 x t2``, degrees, ``(n,)``; the sign of ``t3`` is free."""
        t1, t2, t3 = np.moveaxis(self.T, -1, 0)
        across = np.cross(t1, t2)
        sine = np.linalg.norm(np.cross(across, t3), axis=-1)
        angle: NDArray[np.float64] = np.arctan2(sine, np.abs((across * t3).sum(-1)))
        return np.degrees(angle)


def _differentiate(
    rows: NDArray[np.int32],
    T: NDArray[np.float64],
    samples: NDArray[np.float64],
    displacement: NDArray[np.float64],
    delta: Callable[[float, float], NDArray[np.float64]],
    step: NDArray[np.float64],
) -> LocalSurfaces:
    """Central differences of ``Y = T (u, v, delta)`` at (0, 0).

    Args:
        rows, T, samples: as in :class:`LocalSurfaces`.
        displacement: ``(n, R)`` along ``t3``.
        delta: ``(n,)`` displacements at ``(u, v)``, in steps.
        step: ``(n,)`` of the differences.
    """

    def at(u: float, v: float) -> NDArray[np.float64]:
        local = np.stack([u * step, v * step, delta(u, v)], axis=-1)
        place: NDArray[np.float64] = np.einsum("nab,nb->na", T, local)
        return place

    h = step[:, None]
    middle, east, west, north, south = at(0, 0), at(1, 0), at(-1, 0), at(0, 1), at(0, -1)
    corners = at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)
    return LocalSurfaces(
        rows,
        T,
        displacement * np.linalg.norm(T[:, :, 2], axis=-1, keepdims=True),
        samples,
        Y_u=(east - west) / (2 * h),
        Y_v=(north - south) / (2 * h),
        Y_uu=(east - 2 * middle + west) / h**2,
        Y_uv=corners / (4 * h**2),
        Y_vv=(north - 2 * middle + south) / h**2,
    )


@torch.inference_mode()
def patch_surfaces(net: PUGeoNetPaper, patch: Any) -> LocalSurfaces:
    """Local surfaces of PUGeo-Net as published at the points of a :class:`PointPatch`."""
    assert net.T is not None
    points = torch.from_numpy(patch.points).unsqueeze(0)
    output = net(points)
    assert output.geometry is not None
    axes = principal_axes(points) if net.align else torch.eye(3).unsqueeze(0)
    turned = points @ axes.mT
    features = net.backbone(turned).flatten(0, 1)
    T = net.T(features).unflatten(-1, (3, 3))
    spacing = (3.0 / points.shape[1]) ** 0.5
    step = _STEP * spacing

    def delta(u: float, v: float) -> NDArray[np.float64]:
        lifted = turned[0] + step * (u * T[..., 0] + v * T[..., 1])
        return _double(spacing * net.displacement(lifted.unsqueeze(1), features).flatten())

    count = len(patch.rows)
    scale = patch.radius
    return _differentiate(
        patch.rows,
        _double(output.geometry.T[0]),
        scale * _double(output.geometry.uv[0]),
        scale * _double(output.geometry.displacement[0]),
        lambda u, v: scale * delta(u, v),
        np.full(count, scale * step),
    )


@torch.inference_mode()
def tile_surfaces(net: Any, patch: Any, count: int) -> LocalSurfaces:
    """Local surfaces of the served network at the core points of a :class:`Patch`."""
    from pugeo_model.network.neighbourhoods import stack_patches

    core = patch.core
    charts, uv = net(stack_patches([patch]), torch.from_numpy(patch.frames.quadric[:core]), count)
    displacement = net.surface(charts.code, charts.lift, charts.quadric, uv)[0]
    spacing = patch.frames.spacing[:core].astype(np.float64)
    axes = patch.frames.axes[:core].astype(np.float64)

    def delta(u: float, v: float) -> NDArray[np.float64]:
        at = _STEP * torch.tensor([[[u, v]]], dtype=torch.float32).expand(core, 1, 2)
        height = net.surface(charts.code, charts.lift, charts.quadric, at)[0][:, 0]
        scaled: NDArray[np.float64] = spacing * _double(height)
        return scaled

    return _differentiate(
        patch.rows[:core],
        np.swapaxes(axes, -1, -2) @ _double(charts.T),
        spacing[:, None, None] * _double(uv),
        spacing[:, None] * _double(displacement),
        delta,
        _STEP * spacing,
    )


def _double(values: Tensor) -> NDArray[np.float64]:
    return values.numpy().astype(np.float64)
