# SPDX-License-Identifier: Apache-2.0
"""Recipe files (TOML): all settings of a training run besides the meshes."""

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from pugeo_model.errors import BadOptionError
from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.augment import Mix
from pugeo_model.training.losses import Weights
from pugeo_model.training.trainer import Recipe

__all__ = ["available_recipes", "read_recipe"]

_FOLDER = Path(__file__).parent / "recipes"
_TABLES: dict[str, Any] = {"architecture": Architecture, "mix": Mix, "weights": Weights}


def available_recipes() -> list[str]:
    """Return the names of the recipes of the released weights."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def read_recipe(name_or_path: str) -> Recipe:
    """Read a recipe by name or from a file; missing keys have the defaults of `Recipe`.

    Args:
        name_or_path: name of a recipe of released weights, or path of a ``.toml`` file.

    Raises:
        BadOptionError: no such recipe, or a key or table is invalid.
    """
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
    values: dict[str, Any] = {}
    for key, value in raw.items():
        values[key] = _table(path, key, value) if key in _TABLES else value
    recipe: Recipe = _make(path, Recipe, values)
    return recipe


def _table(path: Path, name: str, raw: Any) -> Any:
    """Convert a table of the file to its dataclass."""
    if not isinstance(raw, Mapping):
        raise BadOptionError(f"{path}: {name} must be a table", value=name)
    values = dict(raw)
    if "options" in values:
        values["options"] = tuple(values["options"].items())
    return _make(path, _TABLES[name], values)


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
