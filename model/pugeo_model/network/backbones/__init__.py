# SPDX-License-Identifier: Apache-2.0
"""Backbones by name. A backbone maps neighbourhoods to features."""

from collections.abc import Callable

from torch import nn

from pugeo_model.network.backbones.charts import ChartsBackbone

__all__ = ["BACKBONES"]

BACKBONES: dict[str, Callable[..., nn.Module]] = {"charts": ChartsBackbone}
