# SPDX-License-Identifier: Apache-2.0
"""Upsampling of clouds in one process."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.assembly import Result, assemble
from pugeo_model.cloud import Cloud
from pugeo_model.formats.meaning import from_array
from pugeo_model.local_stages import LocalStages, Network
from pugeo_model.malloc import give_back_freed_memory
from pugeo_model.options import Options, Position
from pugeo_model.pipeline import run_here, upsample_tile
from pugeo_model.plan import Plan, make_plan

__all__ = ["Upsampler"]


class Upsampler:
    """A network that upsamples clouds in this process.

    Args:
        weights: name of released weights, or path of a ``.safetensors`` file.

    Raises:
        BadOptionError: no such weights.
    """

    def __init__(self, weights: str | Path = "standard") -> None:
        from pugeo_model.weights import load

        self.model: Network = load(weights)

    def __call__(
        self,
        cloud: Cloud | NDArray[Any],
        ratio: float = 4.0,
        *,
        n_points: int | None = None,
        orient: str = "auto",
        viewpoint: Position | tuple[Position, ...] | None = None,
        seed: int = 0,
        keep_input: bool = False,
        density: str = "input",
        spacing: float | None = None,
        max_gap: float | None = None,
        denoise: bool = False,
        confidence: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Result:
        """Upsample a cloud.

        Args:
            cloud: a cloud, or ``(M, K)`` numbers: points, and further columns as in `from_array`.
            ratio: output points per input point, 1..32.
            n_points: number of output points; replaces ``ratio``.
            orient: method that gives normals their signs, see :class:`Options`.
            viewpoint: one or more sensor positions ``(x, y, z)`` in the cloud's frame and units.
            seed: each seed gives another, equally even sample.
            keep_input: begin the output with the cleaned input points, unchanged.
            density: this and the following: see :class:`Options`.
            spacing: mean distance of neighbouring output points; replaces ``ratio``.
            max_gap: largest distance of an output point from the input.
            denoise: with ratio 1, move the input points onto the surface.
            confidence: add the scalar ``expected_error``, in the cloud's units.
            progress: called with the name of the current stage, the number of completed patches,
                and the number of all patches.

        Raises:
            CloudError: the cloud or an option is invalid.
            TypeError: a path instead of a cloud.
        """
        if isinstance(cloud, str | os.PathLike):
            raise TypeError("a path is no cloud: read it first, with pugeo_model.read(path)")
        if not isinstance(cloud, Cloud):
            cloud = from_array(np.asarray(cloud))
        options = Options(
            ratio,
            n_points,
            orient,
            viewpoint,
            seed,
            keep_input,
            density,
            spacing,
            max_gap,
            denoise,
            confidence,
        )
        plan = make_plan(cloud, options, patch_ratio=self.model.patch_ratio)
        return self.upsample(plan, progress)

    def upsample(
        self, plan: Plan, progress: Callable[[str, int, int], None] | None = None
    ) -> Result:
        """Upsample a planned cloud; ``progress`` as in ``__call__``."""
        total, done = plan.report["patches"], 0

        def report_stage(stage: str, fraction: float) -> None:
            if progress:
                progress(stage, done + int(fraction * spec.patches), total)

        stages, tiles = LocalStages(self.model, report_stage), []
        for tile, spec in zip(plan.tiles, plan.tile_specs, strict=True):
            tiles.append(run_here(upsample_tile(stages, tile)))
            done += spec.patches
            if len(plan.tile_specs) > 1:
                # Memory that each tile leaves fragmented would add up.
                give_back_freed_memory()
        result = assemble(plan, tiles)
        if progress:
            progress("finish", total, total)
        return result
