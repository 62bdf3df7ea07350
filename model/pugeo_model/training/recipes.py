# SPDX-License-Identifier: Apache-2.0
"""Recipes as files: all that a run depends on besides the meshes, in TOML."""

import tomllib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from pugeo_model.errors import BadOptionError
from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.augment import Mix
from pugeo_model.training.losses import LossWeights
from pugeo_model.training.patches.settings import Augmentation, PatchSettings, PatchWeights
from pugeo_model.training.trainer import Recipe

__all__ = ["available_recipes", "read_recipe", "with_ratio"]

_DEPTH = 3
_FOLDER = Path(__file__).parent / "recipes"
_TABLES: dict[str, Any] = {
    "architecture": Architecture,
    "mix": Mix,
    "weights": LossWeights,
    "patches": PatchSettings,
}
_PATCH_TABLES: dict[str, Any] = {"augmentation": Augmentation, "weights": PatchWeights}


def available_recipes() -> list[str]:
    """Names of the recipes of the released weights."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def read_recipe(name_or_path: str) -> Recipe:
    """A recipe by its name, or from a file. Missing keys have the defaults of ``Recipe``.

    A file may name a ``base``, another recipe, and then holds only the differences from it.

    Raises:
        BadOptionError: the recipe does not exist or contains an unknown key.
    """
    path, raw = _read(name_or_path, _DEPTH)
    values: dict[str, Any] = {}
    for key, value in raw.items():
        values[key] = _table(path, key, value, _TABLES[key]) if key in _TABLES else value
    recipe: Recipe = _make(path, Recipe, values)
    return recipe


def with_ratio(recipe: Recipe, ratio: int) -> Recipe:
    """The recipe of a patch network for another R.

    Raises:
        BadOptionError: the recipe's network is not made for one R.
    """
    options = dict(recipe.architecture.options)
    if "ratio" not in options:
        raise BadOptionError("only recipes of patch networks have a ratio", value=ratio)
    options["ratio"] = ratio
    architecture = replace(recipe.architecture, options=tuple(options.items()))
    return replace(recipe, architecture=architecture)


def _read(name_or_path: str, depth: int) -> tuple[Path, dict[str, Any]]:
    """Path and tables of a recipe, those of its base filled in."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = _FOLDER / f"{name_or_path}.toml"
    try:
        raw = tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        known = available_recipes()
        raise BadOptionError(
            f"no recipe {name_or_path!r}: give one of {', '.join(known)} or a .toml file",
            value=name_or_path,
            allowed=known,
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadOptionError(f"{path} is not TOML: {error}", value=name_or_path) from error
    base = raw.pop("base", None)
    if base is None:
        return path, raw
    if not isinstance(base, str) or depth == 0:
        raise BadOptionError(
            f"{path}: base must name a recipe, at most {_DEPTH} after one another", value=base
        )
    return path, _merged(_read(base, depth - 1)[1], raw)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a base with what a recipe changes in them.

    A table that names a backbone replaces that of the base: options of another network mean
    nothing to it.
    """
    merged = dict(base)
    for key, value in changes.items():
        inner = merged.get(key)
        if isinstance(value, Mapping) and isinstance(inner, Mapping) and "backbone" not in value:
            merged[key] = _merged(inner, value)
        else:
            merged[key] = value
    return merged


def _table(path: Path, name: str, raw: Any, kind: Any) -> Any:
    if not isinstance(raw, Mapping):
        raise BadOptionError(f"{path}: {name} must be a table", value=name)
    values = dict(raw)
    if "options" in values:
        values["options"] = tuple(values["options"].items())
    if kind is PatchSettings:
        for key in values.keys() & _PATCH_TABLES.keys():
            values[key] = _table(path, f"{name}.{key}", values[key], _PATCH_TABLES[key])
    return _make(path, kind, values)


def _make(path: Path, kind: Any, values: dict[str, Any]) -> Any:
    """Construct a dataclass; unknown keys are an error."""
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise BadOptionError(
            f"{path}: {unknown[0]!r} is unknown; known keys are {', '.join(known)}",
            value=unknown[0],
            allowed=known,
        )
    return kind(**values)
