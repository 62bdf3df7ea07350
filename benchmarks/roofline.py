# SPDX-License-Identifier: Apache-2.0
"""Work of the network for a chart, as the yardstick of its time.

Counted while the network runs on the patches that the pipeline cuts, without the rows that only
fill a patch up (see ``pugeo_model.network.neighbourhoods``): those are time without use, so they
lower the share of the core's rate that is reached, as they should. The rows of a patch's rings,
which its neighbours compute as well, are counted as work.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.case import Work
from pugeo_model import Cloud
from pugeo_model.geometry.patches import Patch
from pugeo_model.local_stages import Network
from pugeo_model.network.model import Model
from pugeo_model.network.neighbourhoods import MessageRound, Neighbourhoods, stack_patches
from pugeo_model.network.precision import bfloat16_pays
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.prepare import prepare

__all__ = ["work"]


def _layer_flops(rows: Sequence[int], weight: Sequence[int], *_: object, **__: object) -> int:
    """Operations of a layer that oneDNN does in one pass; torch's counter knows its own alone."""
    return 2 * math.prod(rows) * weight[0]


_LAYERS = {torch.ops.mkldnn._linear_pointwise: _layer_flops}  # noqa: SLF001  # as the network calls it


class _Traffic(TorchDispatchMode):
    """Counts the bytes of every operation's tensors: what it reads once, what it writes once.

    Caches are not modelled, and neither is what an operation moves within itself: two layers in a
    row count their common tensor twice even where it never left the cache. What is compiled and no
    operation of torch's, sums over edges and their pools, is not seen.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch has no types here
        self.bytes = 0

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Run an operation and count it."""
        result = func(*args, **(kwargs or {}))
        read, written = list(_tensors((args, kwargs))), list(_tensors(result))
        homes = {tensor.untyped_storage().data_ptr() for tensor in read}
        # A view, or a conversion to what the tensor is already, moves nothing.
        same = any(tensor.untyped_storage().data_ptr() in homes for tensor in written)
        if func._schema.is_mutable or not same:  # noqa: SLF001  # torch has no other name for it
            self.bytes += sum(map(_bytes, read)) + sum(map(_bytes, written))
        return result


def work(model: Network, cloud: Cloud, ratio: float) -> Work:
    """Count what the network does for a cloud, on average over its charts.

    Args:
        model: a network that predicts charts.
        cloud: the input.
        ratio: output points an input point; decides how many candidates a chart proposes.
    """
    assert isinstance(model, Model)
    plan = make_plan(cloud, Options(ratio))
    charts, flops, traffic = 0, 0, _Traffic()
    for tile in plan.tiles:
        prepared = prepare(tile)
        for patch in prepared.patches:
            assert isinstance(patch, Patch)
            charts += patch.core
            run = _forward(model, patch, prepared.tile.candidates)
            # One after the other: the first takes operations apart that the second shall see whole.
            counter = FlopCounterMode(display=False, custom_mapping=_LAYERS)
            with torch.inference_mode(), counter:
                run()
            flops += counter.get_total_flops()
            with torch.inference_mode(), traffic:
                run()
    return Work(
        charts=charts,
        flops=flops / charts,
        bytes=traffic.bytes / charts,
        kind="bf16" if bfloat16_pays() else "fp32",
    )


def _forward(model: Model, patch: Patch, candidates: int) -> Callable[[], object]:
    hoods = _needed(stack_patches([patch]), patch)
    quadric = torch.from_numpy(patch.frames.quadric[: patch.core])
    return lambda: model.net(hoods, quadric, candidates)


def _needed(hoods: Neighbourhoods, patch: Patch) -> Neighbourhoods:
    """The inputs of a patch without the rows that fill it up."""
    first, *others = (*patch.rings, patch.core)
    rounds = tuple(
        MessageRound(each.rows[:count], each.sources[:, :count], each.pose[:, :count])
        for each, count in zip(hoods.rounds, others, strict=True)
    )
    return Neighbourhoods(hoods.edges[:, :first], hoods.scalars[:first], rounds)


def _tensors(tree: object) -> Iterator[Tensor]:
    return (leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor))


def _bytes(tensor: Tensor) -> int:
    """Bytes that a tensor lies on: what it repeats, with a stride of zero, is there once."""
    count = tensor.element_size()
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        count *= size if stride else min(size, 1)
    return count
