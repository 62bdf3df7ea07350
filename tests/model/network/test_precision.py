# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from pugeo_model.network import precision
from pugeo_model.network.precision import bfloat16_pays, wide_products


@pytest.mark.parametrize("faster", [torch.bfloat16, torch.float32])
def test_the_faster_one_is_taken(monkeypatch, faster):
    """The dtype with the shorter measured time is used."""
    monkeypatch.setattr(precision, "_seconds", lambda kind: 1.0 if kind == faster else 2.0)
    bfloat16_pays.cache_clear()
    try:
        layer = torch.nn.Linear(8, 8)
        with torch.inference_mode(), wide_products():
            assert layer(torch.ones(3, 8)).dtype == faster
    finally:
        bfloat16_pays.cache_clear()


def test_the_measurement_is_positive():
    """A product takes processor time that can be measured."""
    assert precision._seconds(torch.float32) > 0.0
