# SPDX-License-Identifier: Apache-2.0
"""Recipes as files: all that a run depends on besides the meshes, in TOML."""

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from pugeo_model.errors import BadOption
from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.augment import Mix
from pugeo_model.training.losses import Weights
from pugeo_model.training.patches.settings import Augmentation, PatchSettings, PatchWeights
from pugeo_model.training.trainer import Recipe

__all__ = ["available_recipes", "read_recipe"]

_FOLDER = Path(__file__).parent / "recipes"
_TABLES: dict[str, Any] = {
    "architecture": Architecture,
    "mix": Mix,
    "weights": Weights,
    "patches": PatchSettings,
}
_PATCH_TABLES: dict[str, Any] = {"augmentation": Augmentation, "weights": PatchWeights}


def available_recipes() -> list[str]:
    """Names of the recipes of the released weights."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def read_recipe(name_or_path: str) -> Recipe:
    """A recipe by its name, or from a file; what a file leaves out is as in ``Recipe``.

    Raises:
        BadOption: no such recipe, or it holds what no recipe has.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = _FOLDER / f"{name_or_path}.toml"
    try:
        raw = tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        known = available_recipes()
        raise BadOption(
            f"no recipe {name_or_path!r}: give one of {', '.join(known)} or a .toml file",
            value=name_or_path,
            allowed=known,
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadOption(f"{path} is not TOML: {error}", value=name_or_path) from error
    values: dict[str, Any] = {}
    for key, value in raw.items():
        values[key] = _table(path, key, value, _TABLES[key]) if key in _TABLES else value
    recipe: Recipe = _make(path, Recipe, values)
    return recipe


def _table(path: Path, name: str, raw: Any, kind: Any) -> Any:
    if not isinstance(raw, Mapping):
        raise BadOption(f"{path}: {name} must be a table", value=name)
    values = dict(raw)
    if "options" in values:
        values["options"] = tuple(values["options"].items())
    if kind is PatchSettings:
        for key in values.keys() & _PATCH_TABLES.keys():
            values[key] = _table(path, f"{name}.{key}", values[key], _PATCH_TABLES[key])
    return _make(path, kind, values)


def _make(path: Path, kind: Any, values: dict[str, Any]) -> Any:
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise BadOption(
            f"{path}: {unknown[0]!r} is unknown; there are {', '.join(known)}",
            value=unknown[0],
            allowed=known,
        )
    return kind(**values)
