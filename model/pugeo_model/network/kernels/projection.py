# SPDX-License-Identifier: Apache-2.0
"""Projection, compiled: what ``blend`` says, for serving.

``blend`` is the rule and what training differentiates. Its tensors of millions of 3x3 products
and 8-wide layers are bound by memory: here the geometry of a block of queries is one loop, the one
wide layer a matrix product that stays in the cache, and nothing else is ever written out.
"""

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch.nn import functional

from pugeo_model.network.heads import LOG_ERROR, Surface
from pugeo_model.network.kernels.bfloat16 import bits, to_bfloat16, to_float32
from pugeo_model.network.precision import bfloat16_pays
from pugeo_model.network.projection import FALLOFF, TRUST
from pugeo_model.resample.atlas import ProjectionQuery

__all__ = ["Projector", "bounded_step"]

_ROWS = 4096  # queries times charts a pass: few calls, and what one writes still fits the caches
_GRAIN = 256  # rows of a product are a multiple of this, see `gather`; divides _ROWS
_SHEET = 18  # numbers kept of a chart: basis (9), spacing, its inverse, quadric (6), lift
_TERMS = 8  # inputs of the first layer: u, v, their products, height, slopes
_OFFSET = 4  # numbers kept of a query point on a chart: x, y, z, squared distance in spacings


class Projector:
    """The surface head, ready to project queries.

    Args:
        surface: the head; its weights are copied.
    """

    def __init__(self, surface: Surface) -> None:
        # Rounded here once, as autocast would round them in every call. Where bfloat16 does not
        # pay, the same numbers are multiplied in float32.
        self.kind = torch.bfloat16 if bfloat16_pays() else torch.float32
        self.hidden = surface.hidden.weight.detach().to(torch.bfloat16).to(self.kind)
        self.hidden_bias = surface.hidden.bias.detach().to(torch.bfloat16).to(self.kind)
        self.terms = np.ascontiguousarray(surface.terms.weight.detach().float().numpy().T)
        self.out = np.ascontiguousarray(surface.out.weight.detach().float().numpy())
        self.bias = surface.out.bias.detach().float().numpy().copy()

    @torch.inference_mode()
    def __call__(
        self, query: ProjectionQuery
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        """Blend the charts of every query point.

        Returns:
            Step ``(m, 3)`` float64 from the query point to the surface, cloud units; unit normals
            ``(m, 3)``, sign that of the first chart's; log of the error expected ``(m,)``.
        """
        count, charts = query.charts.shape
        step = np.empty((count, 3))
        normals = np.empty((count, 3), dtype=np.float32)
        log_error = np.empty(count, dtype=np.float32)
        atlas, frames = query.atlas, query.atlas.frames
        codes = torch.from_numpy(atlas.code).float().numpy()
        sheets = _sheets(frames.axes, frames.spacing, frames.quadric, atlas.T, atlas.lift)
        block = _ROWS // charts
        # Bits of bfloat16, which numpy and numba do not know.
        first = np.zeros((_ROWS, codes.shape[1]), dtype=np.int16)
        ready = torch.from_numpy(first).view(torch.bfloat16)
        terms = np.zeros((_ROWS, _TERMS), dtype=np.float32)
        offsets = np.empty((_ROWS, _OFFSET), dtype=np.float32)
        for start in range(0, count, block):
            part = slice(start, min(start + block, count))
            rows = query.charts[part].ravel()
            _place(query.points[part], rows, atlas.points, sheets, terms, offsets)
            _enter(rows, codes, terms, self.terms, first)
            # Rows that are left over from the last pass cost less than a product compiled anew.
            seen = ready[: -(-len(rows) // _GRAIN) * _GRAIN].to(self.kind)
            hidden = functional.linear(seen, self.hidden, self.hidden_bias).to(torch.bfloat16)
            _leave(
                bits(hidden),
                query.charts[part],
                sheets,
                terms,
                offsets,
                self.out,
                self.bias,
                step[part],
                normals[part],
                log_error[part],
            )
        return step, normals, log_error


def bounded_step(
    query: ProjectionQuery, step: NDArray[np.float64], furthest: float
) -> NDArray[np.float64]:
    """Where queries come to lie, ``(m, 3)``: a step further, but near the point of their first chart.

    Args:
        query: the queries.
        step: ``(m, 3)`` float64.
        furthest: distance from that point at most, in its spacings.
    """
    moved = np.empty_like(step)
    # One layout, whatever the number of charts: each would be compiled for itself.
    home, atlas = np.ascontiguousarray(query.charts[:, 0]), query.atlas
    _bounded_step(query.points, step, home, atlas.points, atlas.frames.spacing, furthest, moved)
    return moved


@njit(cache=True, nogil=True)
def _bounded_step(queries, step, home, points, spacing, furthest, moved):  # type: ignore[no-untyped-def]
    for i in range(len(queries)):
        chart = home[i]
        x = queries[i, 0] + step[i, 0] - points[chart, 0]
        y = queries[i, 1] + step[i, 1] - points[chart, 1]
        z = queries[i, 2] + step[i, 2] - points[chart, 2]
        reach = furthest * spacing[chart]
        far = np.sqrt(x * x + y * y + z * z)
        shrink = reach / far if far > reach else 1.0
        moved[i, 0] = points[chart, 0] + x * shrink
        moved[i, 1] = points[chart, 1] + y * shrink
        moved[i, 2] = points[chart, 2] + z * shrink


@njit(cache=True, nogil=True, fastmath=True)
def _sheets(axes, spacing, quadric, T, lift):  # type: ignore[no-untyped-def]
    """What query needs of each chart side by side, ``(n, _SHEET)`` float32.

    Frame and T make one basis: its columns are the chart's tangents and normal in the world.
    """
    count = len(lift)
    sheets = np.empty((count, _SHEET), dtype=np.float32)
    for i in range(count):
        for a in range(3):
            for b in range(3):
                sheets[i, 3 * b + a] = (
                    axes[i, 0, a] * T[i, 0, b]
                    + axes[i, 1, a] * T[i, 1, b]
                    + axes[i, 2, a] * T[i, 2, b]
                )
        sheets[i, 9] = spacing[i]
        sheets[i, 10] = np.float32(1.0) / spacing[i]
        for a in range(6):
            sheets[i, 11 + a] = quadric[i, a]
        sheets[i, 17] = lift[i]
    return sheets


@njit(cache=True, nogil=True, fastmath=True)
def _place(queries, rows, points, sheets, terms, offsets):  # type: ignore[no-untyped-def]
    """Where each query point lies in each of its charts."""
    half = np.float32(0.5)
    charts = len(rows) // len(queries)
    for i in range(len(queries)):
        for row in range(i * charts, (i + 1) * charts):
            chart = rows[row]
            x = np.float32(queries[i, 0] - points[chart, 0])
            y = np.float32(queries[i, 1] - points[chart, 1])
            z = np.float32(queries[i, 2] - points[chart, 2])
            inverse = sheets[chart, 10]
            u = (sheets[chart, 0] * x + sheets[chart, 1] * y + sheets[chart, 2] * z) * inverse
            v = (sheets[chart, 3] * x + sheets[chart, 4] * y + sheets[chart, 5] * z) * inverse
            q1, q2 = sheets[chart, 12], sheets[chart, 13]
            q3, q4, q5 = sheets[chart, 14], sheets[chart, 15], sheets[chart, 16]
            terms[row, 0] = u
            terms[row, 1] = v
            terms[row, 2] = u * u
            terms[row, 3] = u * v
            terms[row, 4] = v * v
            terms[row, 5] = q1 * u + q2 * v + half * q3 * u * u + q4 * u * v + half * q5 * v * v
            terms[row, 6] = q1 + q3 * u + q4 * v
            terms[row, 7] = q2 + q4 * u + q5 * v
            offsets[row, 0], offsets[row, 1], offsets[row, 2] = x, y, z
            offsets[row, 3] = (x * x + y * y + z * z) * inverse * inverse


@njit(cache=True, nogil=True, fastmath=True)
def _enter(rows, codes, terms, weight, first):  # type: ignore[no-untyped-def]
    """The first layer of the head, rectified, in bits of bfloat16."""
    for row in range(len(rows)):
        chart = rows[row]
        t0, t1, t2, t3 = terms[row, 0], terms[row, 1], terms[row, 2], terms[row, 3]
        t4, t5, t6, t7 = terms[row, 4], terms[row, 5], terms[row, 6], terms[row, 7]
        for k in range(codes.shape[1]):
            entered = (
                codes[chart, k]
                + weight[0, k] * t0
                + weight[1, k] * t1
                + weight[2, k] * t2
                + weight[3, k] * t3
                + weight[4, k] * t4
                + weight[5, k] * t5
                + weight[6, k] * t6
                + weight[7, k] * t7
            )
            first[row, k] = to_bfloat16(max(entered, np.float32(0.0)))


@njit(cache=True, nogil=True, fastmath=True)
def _leave(  # type: ignore[no-untyped-def]
    hidden, charts, sheets, terms, offsets, weight, bias, step, normals, log_error
):
    """The last layer, and the blend of what the charts of each query point say."""
    count = charts.shape[1]
    said = np.empty((count, 8), dtype=np.float32)
    one = np.float32(1.0)
    for i in range(len(charts)):
        best = np.float32(-np.inf)
        for c in range(count):
            chart = charts[i, c]
            row = i * count + c
            rise = du = dv = doubt = np.float32(0.0)
            for k in range(hidden.shape[1]):
                h = max(to_float32(hidden[row, k]), np.float32(0.0))
                rise += h * weight[0, k]
                du += h * weight[1, k]
                dv += h * weight[2, k]
                doubt += h * weight[3, k]
            doubt += bias[3] + np.float32(LOG_ERROR)
            u, v = terms[row, 0], terms[row, 1]
            rise += bias[0] + terms[row, 5] + sheets[chart, 17]
            nu, nv = du + bias[1] - terms[row, 6], dv + bias[2] - terms[row, 7]
            size = one / np.sqrt(nu * nu + nv * nv + one)
            spacing = sheets[chart, 9]
            for a in range(3):
                t, s, n = sheets[chart, a], sheets[chart, 3 + a], sheets[chart, 6 + a]
                said[c, a] = (t * u + s * v + n * rise) * spacing - offsets[row, a]
                said[c, 3 + a] = (t * nu + s * nv + n) * size
            said[c, 6] = doubt
            score = -np.float32(FALLOFF) * offsets[row, 3] - np.float32(TRUST) * doubt
            said[c, 7] = score
            best = max(best, score)
        total = x = y = z = nx = ny = nz = expected = np.float32(0.0)
        for c in range(count):
            w = np.exp(said[c, 7] - best)
            total += w
            x += w * said[c, 0]
            y += w * said[c, 1]
            z += w * said[c, 2]
            expected += w * said[c, 6]
            same = said[c, 3] * said[0, 3] + said[c, 4] * said[0, 4] + said[c, 5] * said[0, 5]
            if same < 0:
                w = -w
            nx += w * said[c, 3]
            ny += w * said[c, 4]
            nz += w * said[c, 5]
        step[i, 0], step[i, 1], step[i, 2] = x / total, y / total, z / total
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
        normals[i, 0], normals[i, 1], normals[i, 2] = (
            nx / length,
            ny / length,
            nz / length,
        )
        log_error[i] = expected / total
