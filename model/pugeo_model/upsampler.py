# SPDX-License-Identifier: Apache-2.0
"""The whole way of a cloud in one process."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.merge.atlas import Landed, Landing
from pugeo_model.network.memory import give_back_freed_memory
from pugeo_model.options import Options
from pugeo_model.pipeline import (
    Job,
    Piece,
    Plan,
    Result,
    assemble,
    denoise,
    finish,
    land,
    merge,
    merge_patches,
    noisy,
    own_spots,
    predict,
    prepare,
    propose,
    survey,
)
from pugeo_model.tiles import Cut, Tile

__all__ = ["Upsampler"]


class Upsampler:
    """The whole way in one process.

    Args:
        weights: name of released weights, or the path of a ``.safetensors`` file.
    """

    def __init__(self, weights: str | Path = "standard") -> None:
        from pugeo_model.weights import load

        self.model: Any = load(weights)

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
            progress: called with a stage's name, and how many of the cloud's patches it has done.

        Raises:
            CloudError: the cloud or an option cannot be used.
        """
        if not isinstance(cloud, Cloud):
            cloud = Cloud(np.asarray(cloud, dtype=np.result_type(cloud, np.float32)))
        options = Options(ratio, n_points, orient, viewpoint, seed, keep_input)
        plan = survey(cloud, options, patch_ratio=self.model.patch_ratio)
        return self.upsample(plan, progress)

    def upsample(
        self, plan: Plan, progress: Callable[[str, int, int], None] | None = None
    ) -> Result:
        """Upsample a cloud that was surveyed; ``progress`` as in ``__call__``."""
        total, before = plan.report["patches"], 0
        pieces = []
        for tile, cut in zip(plan.tiles, plan.cuts, strict=True):

            def tell(
                stage: str, share: float = 0.0, *, start: int = before, cut: Cut = cut
            ) -> None:
                if progress:
                    progress(stage, start + int(share * cut.patches), total)

            pieces.append(self._piece(tile, tell))
            before += cut.patches
            if len(plan.cuts) > 1:
                # What tiles leave free between the pieces that stay would add up.
                give_back_freed_memory()
        result = assemble(plan, pieces)
        if progress:
            progress("finish", total, total)
        return result

    def _piece(self, tile: Tile, tell: Callable[..., None]) -> Piece:
        def charted(job: Job) -> list[Any]:
            done: list[Any] = []
            for patch in job.patches:
                tell("network", len(done) / len(job.patches))
                done.append(predict(self.model, patch, job.candidates))
            return done

        def landed(landing: Landing) -> Landed:
            tell("land")
            return land(self.model, landing)

        tell("prepare")
        job = prepare(tile)
        charts = charted(job)
        if tile.patch_ratio is not None:
            tell("merge")
            return finish(job, merge_patches(job, charts))
        if noisy(job):
            tell("denoise")
            again = denoise(job, land(self.model, own_spots(job, charts)))
            if again is not job:
                job = again
                charts = charted(job)
        tell("propose")
        candidates = landed(propose(job, charts))
        tell("merge")
        points = landed(merge(job, charts, candidates))
        tell("finish")
        return finish(job, points)
