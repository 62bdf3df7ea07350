# SPDX-License-Identifier: Apache-2.0
"""The networks that the tables need: one recipe for each method, trained for each R."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pugeo_model.weights import read_card

__all__ = ["ABLATIONS", "RATIOS", "SERVED", "Trained", "megabytes", "needed", "train_missing"]

RATIOS = (4, 8, 12, 16)
"""R of Table 1."""

ABLATIONS = (
    "paper_no_recalibration",
    "paper_no_normals",
    "paper_fixed_uv",
    "paper_no_linear_map",
    "paper_no_coarse",
)
"""Recipes of Table 3, each the full recipe ``paper`` without one part."""

SERVED = tuple(name.replace("paper", "standard") for name in ABLATIONS)
"""The same parts left out of the served network, recipe ``standard``."""

_EVERY = 250  # steps between checkpoints: some minutes on one core
_BYTES = 4  # of a float32
_ADAM = 3  # a weight and its two moments, all of which a training checkpoint keeps


@dataclass(frozen=True)
class Trained:
    """One network of one recipe, trained for one R.

    Attributes:
        recipe: name of the recipe.
        ratio: R; ``None`` where one network serves every R.
    """

    recipe: str
    ratio: int | None

    @property
    def name(self) -> str:
        """Such as ``paper_x4``, or the recipe's name where R does not matter."""
        return self.recipe if self.ratio is None else f"{self.recipe}_x{self.ratio}"

    def weights(self, folder: Path) -> Path:
        """Path of its weights: ``FOLDER/NAME/NAME.safetensors``, in the folder of its run."""
        return folder / self.name / f"{self.name}.safetensors"

    def command(self, folder: Path, steps: int | None = None) -> str:
        """The command that trains it."""
        length = "" if steps is None else f" --steps {steps}"
        ratio = "" if self.ratio is None else f" --ratio {self.ratio}"
        return (
            f"pugeo train MESHES --val VAL --recipe {self.recipe}{ratio}{length}"
            f" --name {self.name} --out {folder / self.name}"
        )

    def card(self, folder: Path) -> dict[str, Any] | None:
        """Its model card, with the weights' hash; ``None`` where it is not trained."""
        path = self.weights(folder)
        return read_card(path) if path.exists() else None

    def impossible(self) -> str | None:
        """The reason why no network of this recipe can have this R, or ``None``."""
        if self.recipe == "mpu" and self.ratio and self.ratio & (self.ratio - 1):
            return "a cascade of 2x steps makes powers of 2 alone"
        return None


def megabytes(card: dict[str, Any]) -> float:
    """Size of weights with the two moments that Adam keeps of each, as the paper counts it."""
    return float(card["parameters"]) * _BYTES * _ADAM / 1e6


def needed() -> list[Trained]:
    """All networks of Tables 1 to 3."""
    comparison = [Trained(recipe, R) for R in RATIOS for recipe in ("paper", "pu_net", "mpu")]
    others = [Trained(recipe, 8) for recipe in ("pu_net_m", *ABLATIONS)]
    served = [Trained(recipe, None) for recipe in (*SERVED, "standard")]
    return [each for each in (*comparison, *others, *served) if each.impossible() is None]


def train_missing(
    meshes: Path,
    val: Path,
    folder: Path,
    wanted: Iterable[Trained],
    steps: int | None,
    tick: Callable[[str, int, str], None],
) -> bool:
    """Train the networks that are not there, or not for as long, one after the other.

    Interrupted, it goes on where it was when called again.

    Args:
        meshes: folder of training meshes.
        val: folder of meshes never trained on.
        folder: of all runs.
        wanted: the networks.
        steps: of each, instead of the recipes' own.
        tick: called with a name, the step and a few words.

    Returns:
        Whether all are trained; ``False`` after SIGTERM.
    """
    from pugeo_model.training.recipes import read_recipe, with_ratio
    from pugeo_model.training.run import load_shapes, run

    shapes, validation = load_shapes(meshes), load_shapes(val)
    for each in wanted:
        recipe = read_recipe(each.recipe)
        if each.ratio is not None:
            recipe = with_ratio(recipe, each.ratio)
        recipe = replace(recipe, steps=recipe.steps if steps is None else steps)
        card = each.card(folder)
        if card is not None and card["training"]["steps"] >= recipe.steps:
            continue

        def told(step: int, words: str, name: str = each.name) -> None:
            tick(name, step, words)

        if not run(
            shapes,
            validation,
            meshes,
            recipe,
            folder / each.name,
            each.name,
            each.recipe,
            every=_EVERY,
            tick=told,
        ):
            return False
    return True
