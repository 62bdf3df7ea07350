# SPDX-License-Identifier: Apache-2.0
"""The ablations of Table 3 on the served network."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pugeo_model.network.pugeo import PUGeoNet
from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import Batches
from pugeo_model.training.losses import JointLoss, LossWeights
from pugeo_model.training.recipes import available_recipes, read_recipe
from pugeo_model.training.trainer import Trainer


@pytest.mark.parametrize(
    "name", [name for name in available_recipes() if name.startswith("standard_no_")]
)
def test_an_ablation_of_ours_is_trained(name, shapes, tmp_path):
    """One step with a small network: the loss is finite; without normals nothing supervises T."""
    recipe = read_recipe(name)
    options = {**dict(recipe.architecture.options), "width": 16, "edge_width": 16}
    tiny = replace(recipe.architecture, features=32, head=32, options=tuple(options.items()))
    trainer = Trainer(shapes, replace(recipe, architecture=tiny, warmup=1), tmp_path)
    parts = trainer._train(trainer._batches()[0])
    assert np.isfinite(parts["loss"])
    if name == "standard_no_normals":
        assert recipe.weights.coarse_normal == recipe.weights.refined_normal == 0.0


def test_without_normal_weights_no_normal_has_a_say(shapes, small):
    """The loss is that of the other terms alone, those of blended normals left out too."""
    torch.manual_seed(0)
    net = PUGeoNet(small)
    count, samples = Batches(shapes, Mix(), 0, 10)[2]

    def total(weights):
        loss, parts = JointLoss(shapes, weights)(net, count, samples, np.random.default_rng(0))
        return float(loss.detach()), parts

    bare, parts = total(LossWeights(coarse_normal=0.0, refined_normal=0.0))
    full, _ = total(LossWeights())
    w = LossWeights()
    extra = w.coarse_normal * parts["coarse_normal"] + w.refined_normal * parts["refined_normal"]
    assert full - bare == pytest.approx(extra + w.blended * parts["blended_normal"] / 6, rel=1e-4)
