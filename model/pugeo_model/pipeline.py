# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud: clean, normalise, patches, network, merge, finish.

    job        = prepare(cloud, options)
    charts     = [predict(model, patch, job.candidates) for patch in job.patches]
    candidates = [land(model, parcel) for parcel in propose(job, charts)]
    points     = [land(model, parcel) for parcel in merge(job, charts, candidates)]
    result     = finish(job, points)

The stages are plain functions of plain data, so that the command line runs them in a row and the
service spreads ``predict`` and ``land`` over its workers; nothing else differs between the two.
Candidates land before the merge too: charts of their neighbours pull outliers in, and the merge
then spreads points that are where they seem to be.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.clean import clean
from pugeo_model.cloud import Cloud
from pugeo_model.errors import BadOption
from pugeo_model.finish.attributes import carry
from pugeo_model.finish.orientation import DIRECT, METHODS, orient, propagate
from pugeo_model.geometry.chunks import PATCH_SIZE, chunks
from pugeo_model.geometry.frames import Frames, fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import Patch, cut
from pugeo_model.merge.atlas import Atlas, Landed, Landing, PatchCharts, bind, parcels
from pugeo_model.merge.placement import place, shares
from pugeo_model.normalise import Placement, normalise

if TYPE_CHECKING:
    from pathlib import Path

    from pugeo_model.network.model import Model

__all__ = [
    "Job",
    "Options",
    "Result",
    "Upsampler",
    "finish",
    "land",
    "merge",
    "predict",
    "prepare",
    "propose",
]

MOST = 32.0
"""Largest ratio."""

_OVERSAMPLE = 1.5  # candidates a point wanted
_TREE = 12  # neighbours in the graph that hands signs of normals on: more cost time, mend little
_NONE = np.empty((0, 0), dtype=np.int32)
_FEWEST_CANDIDATES = 4  # a chart: fewer would leave elimination no choice at small ratios


@dataclass(frozen=True)
class Options:
    """What the caller may choose.

    Attributes:
        ratio: output points an input point, a real number in 1..32. At 1 the input points come
            back, with normals.
        n_points: number of output points instead of a ratio.
        orient: ``auto``, ``input``, ``viewpoint``, ``mst``, ``outward`` or ``none``.
        viewpoint: sensor position in the cloud's own frame and units.
        seed: 0..2^63-1; other seeds give other, equally even samples.
        keep_input: the cleaned input points lead the answer, untouched and in their order, and
            the rest is spread among them. Else every point is new, and noise is smoothed away.

    Raises:
        BadOption: a value out of range; its ``fields`` name it.
    """

    ratio: float = 4.0
    n_points: int | None = None
    orient: str = "auto"
    viewpoint: tuple[float, float, float] | None = None
    seed: int = 0
    keep_input: bool = False

    def __post_init__(self) -> None:
        if not 1.0 <= self.ratio <= MOST:
            _refuse("ratio", self.ratio, "a number from 1 to 32", limit=[1, 32])
        if self.n_points is not None and self.n_points < 1:
            _refuse("n_points", self.n_points, "a positive whole number")
        if self.orient not in METHODS:
            _refuse("orient", self.orient, f"one of {', '.join(METHODS)}", allowed=list(METHODS))
        if self.viewpoint is not None and (not all(math.isfinite(v) for v in self.viewpoint)):
            _refuse("viewpoint", list(self.viewpoint), "three finite numbers x, y, z")
        if self.orient == "viewpoint" and self.viewpoint is None:
            _refuse("viewpoint", None, "given where orient is 'viewpoint'")
        if not 0 <= self.seed < 2**63:
            _refuse("seed", self.seed, "a whole number from 0 to 2^63 - 1")

    def points_out(self, count: int) -> int:
        """Output points for ``count`` input points: exactly round(R M), halves up."""
        return self.n_points or math.floor(self.ratio * count + 0.5)


def _refuse(name: str, value: Any, wanted: str, **fields: Any) -> None:
    raise BadOption(
        f"{name} must be {wanted}, not {value!r}", parameter=name, value=value, **fields
    )


@dataclass(frozen=True, eq=False)
class Job:
    """A prepared cloud.

    Attributes:
        cloud: the cleaned input, rows in the order of the patches.
        order: ``(M,)`` int32, the row that each had before.
        points: ``(M, 3)`` float64, unit scale.
        placement: offset and scale taken out.
        neighbours: ``(M, 32)`` int32, nearest first.
        frames: one a point.
        patches: the units of work; their cores partition the points.
        candidates: candidates a chart.
        n_out: points of the answer.
        options: as asked for.
        report: what happened, JSON-able.
    """

    cloud: Cloud
    order: NDArray[np.int32]
    points: NDArray[np.float64]
    placement: Placement
    neighbours: NDArray[np.int32]
    frames: Frames
    patches: list[Patch]
    candidates: int
    n_out: int
    options: Options
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def keeps_input(self) -> bool:
        """Whether the answer begins with the input points: asked for, or no point is new."""
        return self.options.keep_input or self.n_out == len(self.points)


@dataclass(frozen=True, eq=False)
class Result:
    """The dense cloud and the report on its making."""

    cloud: Cloud
    report: dict[str, Any]


def prepare(cloud: Cloud, options: Options) -> Job:
    """Clean, normalise, find neighbours and frames, cut patches.

    Raises:
        UntreatableCloud: the points left after cleaning span no surface.
        BadOption: ``n_points`` is not 1 to 32 times the points left.
    """
    cleaned, dropped = clean(cloud)
    points, placement = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    if not count <= n_out <= MOST * count:
        _refuse(
            "n_points",
            n_out,
            f"from {count} to {int(MOST) * count} (1 to 32 times the points left after cleaning)",
            limit=[count, int(MOST) * count],
        )
    # Rows in the order of the chunks: a patch's core is then a slice of every array to come.
    parts = chunks(points, PATCH_SIZE)
    order = np.concatenate(parts)
    cleaned, points = cleaned.take(order), points[order]
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    ends = np.cumsum([0] + [len(part) for part in parts])
    patches = [
        cut(np.arange(start, stop, dtype=np.int32), points, neighbours, frames)
        for start, stop in itertools.pairwise(ends)
    ]
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "dropped": {"non_finite": dropped.non_finite, "duplicate": dropped.duplicate},
        "patches": len(patches),
        "ratio": n_out / count,
        "noise": frames.noise,
        "notes": list(cleaned.notes),
    }
    candidates = max(_FEWEST_CANDIDATES, math.ceil(_OVERSAMPLE * n_out / count))
    return Job(
        cloud=cleaned,
        order=order,
        points=points,
        placement=placement,
        neighbours=neighbours,
        frames=frames,
        patches=patches,
        candidates=candidates,
        n_out=n_out,
        options=options,
        report=report,
    )


def predict(model: "Model", patch: Patch, candidates: int) -> PatchCharts:
    """The network: charts of a patch and what they propose. Runs on workers."""
    return model.charts(patch, candidates)


def propose(job: Job, charts: Sequence[PatchCharts]) -> list[Landing]:
    """The candidates of all charts, in parcels with the charts they land on."""
    if job.n_out == len(job.points):
        return []
    atlas = bind(charts)
    spots = (job.points[:, None] + atlas.candidates).reshape(-1, 3)
    owner = np.repeat(np.arange(len(job.points), dtype=np.int32), job.candidates)
    return _parcels(job, atlas, spots, owner)


def land(model: "Model", landing: Landing) -> Landed:
    """The network's heads: put spots on their charts, give them normals. Runs on workers."""
    return model.land(landing)


def merge(job: Job, charts: Sequence[PatchCharts], candidates: Sequence[Landed]) -> list[Landing]:
    """Decide where the output points go; parcels of them, with the charts they land on."""
    atlas = bind(charts)
    rows = np.arange(len(job.points), dtype=np.int32)
    own = _parcels(job, atlas, job.points, rows, fixed=True) if job.keeps_input else []
    if job.n_out == len(job.points):
        return own
    landed = Landed.join(candidates)
    spots, owner = place(
        landed.points,
        landed.normals,
        landed.error,
        landed.nearest,
        job.n_out,
        shares(job.frames.spacing, job.neighbours),
        job.neighbours,
        job.options.seed,
        (job.points, job.frames.axes[:, 2]) if own else None,
    )
    return own + _parcels(job, atlas, spots, owner)


def _parcels(
    job: Job,
    atlas: Atlas,
    spots: NDArray[np.float64],
    owner: NDArray[np.int32],
    *,
    fixed: bool = False,
) -> list[Landing]:
    ends = np.cumsum([patch.core for patch in job.patches])[:-1]
    return parcels(atlas, spots, owner, job.points, job.neighbours, job.frames, ends, fixed=fixed)


def finish(job: Job, points: Sequence[Landed]) -> Result:
    """Orient normals, carry colours and scalars over, put offset and scale back."""
    landed = Landed.join(points)
    options, cloud = job.options, job.cloud
    viewpoint = options.viewpoint
    if viewpoint is not None:
        moved = (np.asarray(viewpoint) - job.placement.offset) / job.placement.scale
        viewpoint = (float(moved[0]), float(moved[1]), float(moved[2]))
    signs, method = orient(
        job.points,
        job.frames.axes[:, 2],
        options.orient,
        viewpoint,
        cloud.normals,
        job.neighbours[:, :_TREE],
    )
    if method in DIRECT:
        normals, _ = orient(landed.points, landed.normals, method, viewpoint, None, _NONE)
    else:
        normals = propagate(landed.normals, landed.nearest, signs)
    colors, scalars = carry(
        Cloud(job.points, colors=cloud.colors, scalars=cloud.scalars), landed.points
    )
    dense = Cloud(
        points=job.placement.world(landed.points),
        normals=normals,
        colors=colors,
        scalars=scalars,
        notes=cloud.notes,
    )
    if job.keeps_input:
        count = len(job.points)
        dense.points[:count] = cloud.points
        dense = dense.take(np.append(np.argsort(job.order), np.arange(count, job.n_out)))
    return Result(dense, {**job.report, "orient": method})


class Upsampler:
    """The whole way in one process.

    Args:
        weights: name of released weights, or the path of a ``.safetensors`` file.
    """

    def __init__(self, weights: "str | Path" = "standard") -> None:
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

        tell("prepare", 0, 1)
        job = prepare(cloud, options)
        charts = spread(
            "network", job.patches, lambda patch: predict(self.model, patch, job.candidates)
        )
        tell("propose", 0, 1)
        candidates = spread("land", propose(job, charts), lambda part: land(self.model, part))
        tell("merge", 0, 1)
        points = spread("land", merge(job, charts, candidates), lambda part: land(self.model, part))
        tell("finish", 0, 1)
        result = finish(job, points)
        tell("finish", 1, 1)
        return result
