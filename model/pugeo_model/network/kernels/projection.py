# SPDX-License-Identifier: Apache-2.0
"""Compiled projection onto blended charts, for inference.

The definition is `pugeo_model.network.projection.blend`, which training differentiates. Its
tensors of millions of 3x3 products and layers of width 8 are limited by memory bandwidth. Here
the geometry of a block of queries is one loop, and the wide layer is a matrix product in the
cache.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from pugeo_model.kernel_compiler import njit
from pugeo_model.network.heads import LOG_ERROR, SurfaceHead
from pugeo_model.network.kernels.bfloat16 import bits, to_bfloat16, to_float32
from pugeo_model.network.precision import bfloat16_pays
from pugeo_model.network.projection import FALLOFF, TRUST
from pugeo_model.resample.atlas import ProjectionQuery

__all__ = ["Projector", "bounded_step"]

_ROWS = 4096  # queries times charts in a block: few calls, and its arrays fit the caches
_GRAIN = 256  # rows of a product are a multiple of it, see `stack_patches`; divides _ROWS
_CHART = 18  # numbers per chart: basis (9), spacing, its inverse, quadric (6), lift
_TERMS = 8  # inputs of the first layer: u, v, their products, height, slopes
_OFFSET = 4  # numbers per query and chart: x, y, z, squared distance in spacings


class Projector:
    """Compiled form of the surface head.

    Args:
        surface: the head; its weights are copied.
    """

    def __init__(self, surface: SurfaceHead) -> None:
        # Rounded to bfloat16 once, as autocast would in each call. Where bfloat16 is emulated,
        # the rounded numbers are multiplied in float32.
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
        """Project query points onto their blended charts.

        Args:
            query: ``m`` points with their charts.

        Returns:
            Step ``(m, 3)`` float64 from the query point to the surface, unit scale; unit normals
            ``(m, 3)`` float32 with the sign of the first chart; log of the predicted error
            ``(m,)`` float32.
        """
        count, charts = query.charts.shape
        step = np.empty((count, 3))
        normals = np.empty((count, 3), dtype=np.float32)
        log_error = np.empty(count, dtype=np.float32)
        atlas, frames = query.atlas, query.atlas.frames
        codes = torch.from_numpy(atlas.code).float().numpy()
        chart_data = _chart_data(frames.axes, frames.spacing, frames.quadric, atlas.T, atlas.lift)
        block = _ROWS // charts
        # Bits of bfloat16, a type that numpy and numba do not support.
        first = np.zeros((_ROWS, codes.shape[1]), dtype=np.int16)
        first_tensor = torch.from_numpy(first).view(torch.bfloat16)
        terms = np.zeros((_ROWS, _TERMS), dtype=np.float32)
        offsets = np.empty((_ROWS, _OFFSET), dtype=np.float32)
        for start in range(0, count, block):
            part = slice(start, min(start + block, count))
            rows = query.charts[part].ravel()
            _to_charts(query.points[part], rows, atlas.points, chart_data, terms, offsets)
            _first_layer(rows, codes, terms, self.terms, first)
            # Stale rows pad the block, since compiling a product for a new size takes longer.
            padded = first_tensor[: -(-len(rows) // _GRAIN) * _GRAIN].to(self.kind)
            hidden = functional.linear(padded, self.hidden, self.hidden_bias).to(torch.bfloat16)
            _last_layer(
                bits(hidden),
                query.charts[part],
                chart_data,
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
    query: ProjectionQuery, step: NDArray[np.float64], largest: float
) -> NDArray[np.float64]:
    """Move query points by their steps, but not far from the point of their first chart.

    Args:
        query: the queries.
        step: ``(m, 3)`` float64.
        largest: largest distance from that point, in its spacings.

    Returns:
        ``(m, 3)`` float64.
    """
    moved = np.empty_like(step)
    # Contiguous, since numba compiles each memory layout separately.
    first, atlas = np.ascontiguousarray(query.charts[:, 0]), query.atlas
    _bounded_step(query.points, step, first, atlas.points, atlas.frames.spacing, largest, moved)
    return moved


@njit(cache=True, nogil=True)
def _bounded_step(queries, step, first, points, spacing, largest, moved):  # type: ignore[no-untyped-def]
    """Write the positions after bounded steps into ``moved``."""
    for i in range(len(queries)):
        chart = first[i]
        x = queries[i, 0] + step[i, 0] - points[chart, 0]
        y = queries[i, 1] + step[i, 1] - points[chart, 1]
        z = queries[i, 2] + step[i, 2] - points[chart, 2]
        radius = largest * spacing[chart]
        distance = np.sqrt(x * x + y * y + z * z)
        shrink = radius / distance if distance > radius else 1.0
        moved[i, 0] = points[chart, 0] + x * shrink
        moved[i, 1] = points[chart, 1] + y * shrink
        moved[i, 2] = points[chart, 2] + z * shrink


@njit(cache=True, nogil=True, fastmath=True)
def _chart_data(axes, spacing, quadric, T, lift):  # type: ignore[no-untyped-def]
    """Pack the data of each chart into one row, ``(n, _CHART)`` float32.

    Canonical frame and T give one basis: tangents and normal of the chart in the cloud's frame.
    """
    count = len(lift)
    chart_data = np.empty((count, _CHART), dtype=np.float32)
    for i in range(count):
        for a in range(3):
            for b in range(3):
                chart_data[i, 3 * b + a] = (
                    axes[i, 0, a] * T[i, 0, b]
                    + axes[i, 1, a] * T[i, 1, b]
                    + axes[i, 2, a] * T[i, 2, b]
                )
        chart_data[i, 9] = spacing[i]
        chart_data[i, 10] = np.float32(1.0) / spacing[i]
        for a in range(6):
            chart_data[i, 11 + a] = quadric[i, a]
        chart_data[i, 17] = lift[i]
    return chart_data


@njit(cache=True, nogil=True, fastmath=True)
def _to_charts(queries, rows, points, chart_data, terms, offsets):  # type: ignore[no-untyped-def]
    """Coordinates of each query in each of its charts; writes ``terms`` and ``offsets``."""
    half = np.float32(0.5)
    charts = len(rows) // len(queries)
    for i in range(len(queries)):
        for row in range(i * charts, (i + 1) * charts):
            chart = rows[row]
            x = np.float32(queries[i, 0] - points[chart, 0])
            y = np.float32(queries[i, 1] - points[chart, 1])
            z = np.float32(queries[i, 2] - points[chart, 2])
            inverse = chart_data[chart, 10]
            u = (
                chart_data[chart, 0] * x + chart_data[chart, 1] * y + chart_data[chart, 2] * z
            ) * inverse
            v = (
                chart_data[chart, 3] * x + chart_data[chart, 4] * y + chart_data[chart, 5] * z
            ) * inverse
            q1, q2 = chart_data[chart, 12], chart_data[chart, 13]
            q3, q4, q5 = chart_data[chart, 14], chart_data[chart, 15], chart_data[chart, 16]
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
def _first_layer(rows, codes, terms, weight, first):  # type: ignore[no-untyped-def]
    """First layer of the head with ReLU, as bits of bfloat16."""
    for row in range(len(rows)):
        chart = rows[row]
        t0, t1, t2, t3 = terms[row, 0], terms[row, 1], terms[row, 2], terms[row, 3]
        t4, t5, t6, t7 = terms[row, 4], terms[row, 5], terms[row, 6], terms[row, 7]
        for k in range(codes.shape[1]):
            total = (
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
            first[row, k] = to_bfloat16(max(total, np.float32(0.0)))


@njit(cache=True, nogil=True, fastmath=True)
def _last_layer(  # type: ignore[no-untyped-def]
    hidden, charts, chart_data, terms, offsets, weight, bias, step, normals, log_error
):
    """Last layer of the head, and the blend of the charts of each query."""
    count = charts.shape[1]
    # For each chart: step (3), normal (3), log error, log weight.
    results = np.empty((count, 8), dtype=np.float32)
    one = np.float32(1.0)
    for i in range(len(charts)):
        best = np.float32(-np.inf)
        for c in range(count):
            chart = charts[i, c]
            row = i * count + c
            rise = du = dv = chart_log_error = np.float32(0.0)
            for k in range(hidden.shape[1]):
                h = max(to_float32(hidden[row, k]), np.float32(0.0))
                rise += h * weight[0, k]
                du += h * weight[1, k]
                dv += h * weight[2, k]
                chart_log_error += h * weight[3, k]
            chart_log_error += bias[3] + np.float32(LOG_ERROR)
            u, v = terms[row, 0], terms[row, 1]
            rise += bias[0] + terms[row, 5] + chart_data[chart, 17]
            nu, nv = du + bias[1] - terms[row, 6], dv + bias[2] - terms[row, 7]
            size = one / np.sqrt(nu * nu + nv * nv + one)
            spacing = chart_data[chart, 9]
            for a in range(3):
                t, s, n = chart_data[chart, a], chart_data[chart, 3 + a], chart_data[chart, 6 + a]
                results[c, a] = (t * u + s * v + n * rise) * spacing - offsets[row, a]
                results[c, 3 + a] = (t * nu + s * nv + n) * size
            results[c, 6] = chart_log_error
            score = -np.float32(FALLOFF) * offsets[row, 3] - np.float32(TRUST) * chart_log_error
            results[c, 7] = score
            best = max(best, score)
        total = x = y = z = nx = ny = nz = expected = np.float32(0.0)
        for c in range(count):
            w = np.exp(results[c, 7] - best)
            total += w
            x += w * results[c, 0]
            y += w * results[c, 1]
            z += w * results[c, 2]
            expected += w * results[c, 6]
            same = (
                results[c, 3] * results[0, 3]
                + results[c, 4] * results[0, 4]
                + results[c, 5] * results[0, 5]
            )
            if same < 0:
                w = -w
            nx += w * results[c, 3]
            ny += w * results[c, 4]
            nz += w * results[c, 5]
        step[i, 0], step[i, 1], step[i, 2] = x / total, y / total, z / total
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
        normals[i, 0], normals[i, 1], normals[i, 2] = (
            nx / length,
            ny / length,
            nz / length,
        )
        log_error[i] = expected / total
