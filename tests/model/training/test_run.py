# SPDX-License-Identifier: Apache-2.0
"""Complete training runs."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from pugeo_model.mesh.files import mesh_files
from pugeo_model.training.corpus import content_hash
from pugeo_model.training.run import licences, load_shapes, run
from pugeo_model.training.trainer import Recipe, Trainer


def train(shapes, meshes, recipe, folder, every=3):
    """Run a recipe without progress."""
    run(shapes, [], meshes, recipe, folder, "small", "own.toml", every, lambda *_: None)


@pytest.mark.slow
def test_a_run_resumes_exactly(shapes, meshes, small, tmp_path):
    """Six steps in a row and three plus three give the same weights, bit for bit."""
    for folder, lengths in (("once", [6]), ("twice", [3, 6])):
        for steps in lengths:
            recipe = Recipe(small, steps=steps, warmup=2, cooldown=0.0)
            train(shapes, meshes, recipe, tmp_path / folder)
    once, twice = (tmp_path / name / "small.safetensors" for name in ("once", "twice"))
    assert once.read_bytes() == twice.read_bytes()
    for name in ("log.csv", "curves.png", "small.json", "checkpoint.pt"):
        assert (tmp_path / "once" / name).stat().st_size > 0


@pytest.mark.slow
def test_a_run_starts_from_weights(shapes, meshes, small, tmp_path):
    """The network starts with the given weights, and the recipe of the card names them."""
    recipe = Recipe(small, steps=2, warmup=1)
    train(shapes, meshes, recipe, tmp_path / "first", every=2)
    weights = str(tmp_path / "first" / "small.safetensors")
    started = Trainer(shapes, replace(recipe, start=weights), tmp_path / "second")
    for name, value in load_file(weights).items():
        torch.testing.assert_close(started.net.state_dict()[name], value)
    assert started.recipe.to_json()["start"] == weights


@pytest.mark.slow
def test_the_card_describes_the_run(shapes, meshes, small, tmp_path):
    """The card has the recipe, the number of steps, the data hash and the command."""
    recipe = Recipe(small, steps=1, warmup=1)
    train(shapes, meshes, recipe, tmp_path, every=1)
    card = json.loads((tmp_path / "small.json").read_text("utf-8"))
    assert card["name"] == "small"
    assert card["architecture"] == small.to_json()
    training = card["training"]
    assert training["recipe"] == json.loads(json.dumps(recipe.to_json()))
    assert training["steps"] == 1
    assert training["data_sha256"] == content_hash(mesh_files(meshes))
    assert "--recipe own.toml --steps 1 --seed 0" in training["command"]


def test_shapes_are_loaded_with_progress(meshes, tmp_path, monkeypatch):
    """Each mesh of the folder is loaded, and the number before each is reported."""
    monkeypatch.setenv("PUGEO_CACHE", str(tmp_path))
    ticks: list[tuple[int, int]] = []
    (shape,) = load_shapes(meshes, lambda *tick: ticks.append(tick))
    assert shape.name == "ball"
    assert ticks == [(0, 1)]


@pytest.mark.parametrize("manifest", [True, False])
def test_licences_come_from_the_manifest(tmp_path, manifest):
    """Only the training shapes are counted; without a manifest there are no licences."""
    if manifest:
        rows = ["name\tlicence", "a\tCC0", "b\tCC-BY", "c\tCC0", "d\tCC0"]
        (tmp_path / "MANIFEST.tsv").write_text("\n".join(rows) + "\n")
    found = licences(tmp_path / "train", {"a", "b", "c"})
    assert found == ({"CC0": 2, "CC-BY": 1} if manifest else {})
