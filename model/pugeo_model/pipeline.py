# SPDX-License-Identifier: Apache-2.0
"""Orchestration of the stages of a tile.

    cloud  = read("scan.ply")                   # formats
    plan   = make_plan(cloud, options)          # clean, normalise, divide into tiles
    tiles  = [await upsample_tile(stages, tile) for tile in plan.tiles]
    result = assemble(plan, tiles)              # consistent signs, seams, one cloud
    write(result.cloud, "dense.ply")            # formats

`upsample_tile` is the only orchestration: the command line runs it with `LocalStages`, the service
with stages that run on workers, the baselines with fitted charts. This module imports neither
torch nor numba, so that the HTTP process of the service need not load them.
"""

from collections.abc import Coroutine
from typing import Any, Protocol, TypeVar

__all__ = ["TileStages", "run_here", "upsample_tile"]

TileT = TypeVar("TileT")
PreparedT = TypeVar("PreparedT")
ChartsT = TypeVar("ChartsT")
DenseT_co = TypeVar("DenseT_co", covariant=True)
T = TypeVar("T")


class TileStages(Protocol[TileT, PreparedT, ChartsT, DenseT_co]):
    """The stages of a tile, run in this process or on workers.

    The type parameters are the values passed between stages: in this process the values
    themselves, on workers handles to them.
    """

    async def prepare(self, tile: TileT) -> PreparedT:
        """Find neighbours, fit canonical frames and extract patches."""

    async def predict(self, prepared: PreparedT) -> ChartsT:
        """Run all patches through the network."""

    def needs_denoising(self, prepared: PreparedT) -> bool:
        """Return whether the points are noisy and were not moved yet."""

    async def denoise(self, prepared: PreparedT, charts: ChartsT) -> TileT | None:
        """Move the points onto their charts; ``None`` if they hardly move."""

    async def densify(self, prepared: PreparedT, charts: ChartsT) -> DenseT_co:
        """Compute the dense points: propose, project, select, project, finish."""


async def upsample_tile(
    stages: TileStages[TileT, PreparedT, ChartsT, DenseT_co], tile: TileT
) -> DenseT_co:
    """Upsample a tile: from its points to its dense points (section 3 of the paper).

    Args:
        stages: runs each stage.
        tile: the points of a core and of the margin around it.
    """
    # Each neighbourhood is transformed to a canonical frame, so that the network need not learn
    # rotation, scale or density.
    prepared = await stages.prepare(tile)
    # Features of each neighbourhood, and from them a chart at each point: samples (u, v) in the
    # parameter plane (eq. 3) and the matrix T that maps them to the tangent plane (eq. 4, 5).
    charts = await stages.predict(prepared)
    if stages.needs_denoising(prepared):
        # Points of a noisy input are moved onto their charts, then new charts are predicted.
        # If they hardly move, the input is exact, and the charts stay valid.
        moved = await stages.denoise(prepared, charts)
        if moved is not None:
            prepared = await stages.prepare(moved)
            charts = await stages.predict(prepared)
    # Displacements and normals of the candidates (eq. 6 to 8), and the selection among them.
    return await stages.densify(prepared, charts)


def run_here(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never waits, without an event loop, and return its result.

    Raises:
        RuntimeError: the coroutine waited.
    """
    try:
        coroutine.send(None)
    except StopIteration as done:
        value: T = done.value
        return value
    coroutine.close()
    raise RuntimeError("a local stage waited for an event loop")
