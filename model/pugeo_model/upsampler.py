# SPDX-License-Identifier: Apache-2.0
"""The whole way of a cloud in one process."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.network.memory import give_back_freed_memory
from pugeo_model.options import Options
from pugeo_model.pipeline import (
    Piece,
    Result,
    assemble,
    finish,
    land,
    merge,
    predict,
    prepare,
    propose,
    survey,
)
from pugeo_model.tiles import Tile

__all__ = ["Upsampler"]


class Upsampler:
    """The whole way in one process.

    Args:
        weights: name of released weights, or the path of a ``.safetensors`` file.
    """

    def __init__(self, weights: str | Path = "standard") -> None:
        from pugeo_model.weights import load

        self.model = load(weights)

    def __call__(
        self,
        cloud: Cloud | NDArray[Any],
        ratio: float = 4.0,
        *,
        n_points: int | None = None,
        orient: str = "auto",
        viewpoint: tuple[float, float, float] | None = None,
        seed: int = 0,
        keep_input: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Result:
        """Upsample a cloud; arguments as in :class:`Options`.

        Args:
            cloud: a cloud, or points ``(M, 3)``.
            progress: called with a stage's name, parts done and parts in all.

        Raises:
            CloudError: the cloud or an option cannot be used.
        """
        if not isinstance(cloud, Cloud):
            cloud = Cloud(np.asarray(cloud, dtype=np.result_type(cloud, np.float32)))
        options = Options(ratio, n_points, orient, viewpoint, seed, keep_input)
        tell = progress or (lambda _stage, _done, _total: None)

        def spread(stage: str, parts: Sequence[Any], work: Callable[[Any], Any]) -> list[Any]:
            done: list[Any] = []
            for part in parts:
                tell(stage, len(done), len(parts))
                done.append(work(part))
            return done

        def upsample(tile: Tile) -> Piece:
            tell("prepare", 0, 1)
            job = prepare(tile)
            charts = spread(
                "network", job.patches, lambda patch: predict(self.model, patch, job.candidates)
            )
            tell("propose", 0, 1)
            candidates = spread("land", propose(job, charts), lambda part: land(self.model, part))
            tell("merge", 0, 1)
            parcels = merge(job, charts, candidates)
            points = spread("land", parcels, lambda part: land(self.model, part))
            tell("finish", 0, 1)
            piece = finish(job, points)
            if len(plan.cuts) > 1:
                # What tiles leave free between the pieces that stay would add up.
                give_back_freed_memory()
            return piece

        plan = survey(cloud, options)
        tiles = (plan.tile(number) for number in range(len(plan.cuts)))
        result = assemble(plan, [upsample(tile) for tile in tiles])
        tell("finish", 1, 1)
        return result
