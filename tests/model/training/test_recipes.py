# SPDX-License-Identifier: Apache-2.0
"""Recipe files."""

import json

import pytest

from pugeo_model.errors import BadOptionError
from pugeo_model.network.build import build_network
from pugeo_model.training.recipes import available_recipes, read_recipe
from pugeo_model.training.trainer import Recipe
from pugeo_model.weights import available, read_card


@pytest.mark.parametrize("name", available_recipes())
def test_recipes_of_released_weights(name):
    """Each recipe defines a network and equals the recipe in the card of the weights."""
    recipe = read_recipe(name)
    net = build_network(recipe.architecture)
    assert recipe.to_json()["architecture"] == net.architecture.to_json()
    if name in available():
        trained = read_card(name)["training"]["recipe"]
        assert json.dumps(trained) == json.dumps(recipe.to_json())


def test_the_default_recipe_is_that_of_the_default_weights():
    """The recipe ``standard`` equals the defaults in the code."""
    assert read_recipe("standard") == Recipe()


def test_missing_keys_have_defaults(tmp_path):
    """A file needs only the keys that differ from the defaults."""
    path = tmp_path / "mine.toml"
    path.write_text("steps = 7\n[architecture]\noptions = {width = 8}\n[mix]\nnoisy = 0.5\n")
    recipe = read_recipe(str(path))
    assert (recipe.steps, recipe.mix.noisy, recipe.rate) == (7, 0.5, Recipe().rate)
    assert recipe.architecture.options == (("width", 8),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepz = 1", "'stepz' is unknown"),
        ("[mix]\nnoizy = 1", "'noizy' is unknown"),
        ("mix = 3", "mix must be a table"),
        ("=", "not TOML"),
    ],
)
def test_invalid_files(tmp_path, text, message):
    """An unknown key, a value in place of a table and a syntax error are named."""
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(BadOptionError, match=message):
        read_recipe(str(path))


def test_an_unknown_recipe():
    """The error lists the recipes that exist."""
    with pytest.raises(BadOptionError, match="standard"):
        read_recipe("unknown")
