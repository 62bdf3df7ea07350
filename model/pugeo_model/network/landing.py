# SPDX-License-Identifier: Apache-2.0
"""Landing, compiled: what ``blend`` says, for serving.

``blend`` is the rule and what training differentiates. Its tensors of millions of 3x3 products
and 8-wide layers are bound by memory: here the geometry of a block of spots is one loop, the one
wide layer a matrix product that stays in the cache, and nothing else is ever written out.
"""

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from pugeo_model.merge.atlas import Landing
from pugeo_model.network.blend import FALLOFF, TRUST
from pugeo_model.network.heads import LOG_ERROR, Surface
from pugeo_model.network.precision import wide_products

__all__ = ["Lander"]

_BLOCK = 1024  # spots a pass: few calls, and what a pass writes still fits the caches
_GEOMETRY = 9  # numbers kept of a spot on a chart: u, v, height, slopes, local x, y, z, distance


class Lander:
    """The surface head, ready to land spots.

    Args:
        surface: the head; its weights are copied.
    """

    def __init__(self, surface: Surface) -> None:
        self.hidden = surface.hidden
        self.terms = np.ascontiguousarray(surface.terms.weight.detach().float().numpy().T)
        self.out = np.ascontiguousarray(surface.out.weight.detach().float().numpy().T)
        self.bias = surface.out.bias.detach().float().numpy().copy()

    @torch.inference_mode()
    def __call__(
        self, landing: Landing
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        """Blend the charts of every spot.

        Returns:
            Step ``(m, 3)`` float64 from the spot to the surface, cloud units; unit normals
            ``(m, 3)``, sign that of the first chart's; log of the error expected ``(m,)``.
        """
        count, charts = landing.charts.shape
        step = np.empty((count, 3))
        normals = np.empty((count, 3), dtype=np.float32)
        log_error = np.empty(count, dtype=np.float32)
        codes = landing.code.astype(np.float32)
        first = np.empty((_BLOCK * charts, codes.shape[1]), dtype=np.float32)
        geometry = np.empty((_BLOCK * charts, _GEOMETRY), dtype=np.float32)
        for start in range(0, count, _BLOCK):
            part = slice(start, min(start + _BLOCK, count))
            rows = (part.stop - start) * charts
            _enter(
                landing.spots[part],
                landing.charts[part],
                landing.points,
                landing.axes,
                landing.spacing,
                landing.quadric,
                landing.T,
                codes,
                self.terms,
                first,
                geometry,
            )
            with wide_products():
                hidden = self.hidden(torch.from_numpy(first[:rows])).float().numpy()
            _leave(
                hidden,
                geometry,
                landing.charts[part],
                landing.axes,
                landing.spacing,
                landing.T,
                landing.lift,
                self.out,
                self.bias,
                step[part],
                normals[part],
                log_error[part],
            )
        return step, normals, log_error


@njit(cache=True, nogil=True, fastmath=True)
def _enter(spots, charts, points, axes, spacing, quadric, T, codes, weight, first, geometry):  # type: ignore[no-untyped-def]
    """Where each spot lies in each of its charts, and the first layer of the head there."""
    width = codes.shape[1]
    for i in range(len(spots)):
        for c in range(charts.shape[1]):
            chart = charts[i, c]
            row = i * charts.shape[1] + c
            scale = spacing[chart]
            x = np.float32(spots[i, 0] - points[chart, 0])
            y = np.float32(spots[i, 1] - points[chart, 1])
            z = np.float32(spots[i, 2] - points[chart, 2])
            f, t, q = axes[chart], T[chart], quadric[chart]
            a = (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z) / scale
            b = (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z) / scale
            d = (f[2, 0] * x + f[2, 1] * y + f[2, 2] * z) / scale
            u = a * t[0, 0] + b * t[1, 0] + d * t[2, 0]
            v = a * t[0, 1] + b * t[1, 1] + d * t[2, 1]
            half = np.float32(0.5)
            height = q[1] * u + q[2] * v + half * q[3] * u * u + q[4] * u * v + half * q[5] * v * v
            along = q[1] + q[3] * u + q[4] * v
            across = q[2] + q[4] * u + q[5] * v
            uu, uv, vv = u * u, u * v, v * v
            for k in range(width):
                value = (
                    codes[chart, k]
                    + weight[0, k] * u
                    + weight[1, k] * v
                    + weight[2, k] * uu
                    + weight[3, k] * uv
                    + weight[4, k] * vv
                    + weight[5, k] * height
                    + weight[6, k] * along
                    + weight[7, k] * across
                )
                first[row, k] = max(value, np.float32(0.0))
            g = geometry[row]
            g[0], g[1], g[2], g[3], g[4] = u, v, height, along, across
            g[5], g[6], g[7] = a, b, d
            g[8] = a * a + b * b + d * d


@njit(cache=True, nogil=True, fastmath=True)
def _leave(  # type: ignore[no-untyped-def]
    hidden, geometry, charts, axes, spacing, T, lift, weight, bias, step, normals, log_error
):
    """The last layer, and the blend of what the charts of each spot say."""
    count = charts.shape[1]
    steps = np.empty((count, 3), dtype=np.float32)
    turned = np.empty((count, 3), dtype=np.float32)
    doubt = np.empty(count, dtype=np.float32)
    score = np.empty(count, dtype=np.float32)
    for i in range(len(charts)):
        best = np.float32(-np.inf)
        for c in range(count):
            chart = charts[i, c]
            row = i * count + c
            rise, du, dv, doubt[c] = bias[0], bias[1], bias[2], bias[3]
            for k in range(hidden.shape[1]):
                h = max(hidden[row, k], np.float32(0.0))
                rise += h * weight[k, 0]
                du += h * weight[k, 1]
                dv += h * weight[k, 2]
                doubt[c] += h * weight[k, 3]
            doubt[c] += np.float32(LOG_ERROR)
            g, f, t = geometry[row], axes[chart], T[chart]
            rise += g[2] + lift[chart]
            nu, nv = du - g[3], dv - g[4]
            size = np.float32(1.0) / np.sqrt(nu * nu + nv * nv + np.float32(1.0))
            for a in range(3):
                steps[c, a] = 0.0
                turned[c, a] = 0.0
            for b in range(3):
                moved = t[b, 0] * g[0] + t[b, 1] * g[1] + t[b, 2] * rise - g[5 + b]
                normal = (t[b, 0] * nu + t[b, 1] * nv + t[b, 2]) * size
                for a in range(3):
                    steps[c, a] += moved * f[b, a] * spacing[chart]
                    turned[c, a] += normal * f[b, a]
            score[c] = -np.float32(FALLOFF) * g[8] - np.float32(TRUST) * doubt[c]
            best = max(best, score[c])
        total = np.float32(0.0)
        for c in range(count):
            score[c] = np.exp(score[c] - best)
            total += score[c]
        x = y = z = nx = ny = nz = expected = np.float32(0.0)
        for c in range(count):
            w = score[c] / total
            x += w * steps[c, 0]
            y += w * steps[c, 1]
            z += w * steps[c, 2]
            expected += w * doubt[c]
            same = (
                turned[c, 0] * turned[0, 0]
                + turned[c, 1] * turned[0, 1]
                + turned[c, 2] * turned[0, 2]
            )
            if same < 0:
                w = -w
            nx += w * turned[c, 0]
            ny += w * turned[c, 1]
            nz += w * turned[c, 2]
        step[i, 0], step[i, 1], step[i, 2] = x, y, z
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
        normals[i, 0], normals[i, 1], normals[i, 2] = nx / length, ny / length, nz / length
        log_error[i] = expected
