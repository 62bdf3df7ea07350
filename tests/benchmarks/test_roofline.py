# SPDX-License-Identifier: Apache-2.0
"""The network's work is counted as one would with a pencil."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

pytest.importorskip("benchmarks", reason="not part of a source distribution")

from benchmarks.roofline import _Traffic, work

from pugeo_model import Cloud
from pugeo_model.geometry.patches import EDGE, MESSAGES, POSE, SCALARS
from pugeo_model.network.model import Model
from pugeo_model.network.precision import bfloat16_pays
from pugeo_model.upsampler import Upsampler

SCALES, NEIGHBOURS, MESSAGE = 4, 32, 12  # pools, neighbours pooled, messages a round


def test_products_of_a_chart(sphere: NDArray[np.float32]) -> None:
    """One closed patch of 600 points, which has no rings: each layer's inputs times its outputs.

    Filled up it has 640 rows; counting those would give 7 % more.
    """
    model = Upsampler().model
    assert isinstance(model, Model)
    architecture = model.net.architecture
    options = dict(architecture.options)
    f, w, e = architecture.features, options["width"], options["edge_width"]
    head, candidates, rounds = architecture.head, 6, len(MESSAGES)
    neighbours = NEIGHBOURS * (EDGE * e + e * e)  # two layers; pools are no products
    neighbours += SCALES * e * SCALES + (SCALES * e + SCALARS) * w
    wide = 2 * w * w + 3 * w * w + 2 * options["expansion"] * w * w
    messages = rounds * (MESSAGE * (POSE * w + w * w) + wide)
    outwards = (rounds + 1) * w * (rounds + 1 + f)
    heads = f * (2 + head + 6 + 4 + head // 2)
    samples = candidates * ((head // 2) ** 2 + 2 * head // 2)
    once = candidates * 4 * head // 2 / 600  # what the samples' pattern costs, all charts together
    exact = neighbours + messages + outwards + heads + samples + once
    if not bfloat16_pays():
        # In float32 the mean over neighbours is a product with a row of ones.
        exact += NEIGHBOURS * e + rounds * MESSAGE * w

    found = work(model, Cloud(sphere), 4.0)
    assert found.charts == 600
    assert found.flops == pytest.approx(2.0 * exact, rel=1e-6)
    # Values of the first layer alone move more; products all reuse what they read.
    assert 2.0 * NEIGHBOURS * e < found.bytes < 4.0 * found.flops


def test_bytes_of_operations() -> None:
    """Inputs are read and outputs written once; views move nothing, repeated values are one."""
    ten = torch.ones(10)

    def moved(operation: Callable[[], object]) -> int:
        traffic = _Traffic()
        with torch.inference_mode(), traffic:
            operation()
        return traffic.bytes

    assert moved(lambda: ten + ten) == 3 * 40
    assert moved(ten.relu_) == 2 * 40
    assert moved(ten.double) == 40 + 80
    assert moved(ten.float) == moved(lambda: ten[:5]) == moved(lambda: ten.view(2, 5)) == 0
    repeated = ten[:1].expand(10)
    assert moved(lambda: repeated + ten) == 4 + 40 + 40
    assert moved(lambda: torch.cat([ten, ten])) == 40 + 40 + 80
