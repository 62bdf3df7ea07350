# SPDX-License-Identifier: Apache-2.0
"""Tables 1, 2 and 3 of the paper: which methods, on which weights, in which order."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.pca_normals import pca_normals
from pugeo_model.reproduce import printed
from pugeo_model.reproduce.rows import Row, RowStore
from pugeo_model.reproduce.stored import stored
from pugeo_model.reproduce.trained import ABLATIONS, RATIOS, SERVED, Trained, megabytes
from pugeo_model.upsampler import Upsampler
from pugeo_model.weights import read_card

__all__ = ["LABELS", "PCA_COUNTS", "Line", "ablation", "comparison", "normals"]

PCA_COUNTS = (10, 15, 25, 35, 45)
"""Neighbours of the PCA rows of Table 2."""

LABELS = {
    "ear": "EAR",
    "pu_net": "PU-Net",
    "pu_net_m": "PU-Net-M",
    "mpu": "MPU",
    "paper": "PUGeo-Net as published",
    "paper_no_recalibration": "without feature recalibration",
    "paper_no_normals": "without normal prediction",
    "paper_fixed_uv": "without adaptive (u, v)",
    "paper_no_linear_map": "without the linear map T",
    "paper_no_coarse": "without coarse to fine",
}
"""Recipes and methods as tables call them."""

Method = Callable[[Cloud, float], Cloud]


@dataclass(frozen=True)
class Line:
    """One line of a table.

    Attributes:
        method: as the table calls it.
        ratio: R.
        row: measured; ``None`` where there is none, and ``why`` says why.
        why: ``row`` is missing.
        printed: the paper's numbers for it.
        megabytes: network size as the paper counts it.
        printed_megabytes: the paper's.
        budget: steps and hours of training.
        command: that trains the network.
    """

    method: str
    ratio: int
    row: Row | None
    why: str = ""
    printed: tuple[float, ...] | None = None
    megabytes: float | None = None
    printed_megabytes: float | None = None
    budget: str = ""
    command: str = ""


def comparison(store: RowStore, folder: Path, served: str) -> Iterator[Line]:
    """Table 1: EAR, PU-Net, MPU, the paper's network and the served one, for every R.

    Args:
        store: measures.
        folder: of the trained networks.
        served: released weights, or the path of a ``.safetensors`` file.
    """
    for ratio in RATIOS:
        yield _ear(store, folder, ratio)
        for recipe in ("pu_net", "mpu", "paper"):
            line = _trained(store, folder, Trained(recipe, ratio), ratio)
            key = (recipe, ratio)
            yield replace(
                line,
                printed=printed.COMPARISON.get(key),
                printed_megabytes=printed.SIZES_MB.get(key),
            )
        yield _served(store, served, ratio)


def normals(store: RowStore, folder: Path, served: str, ratio: int = 8) -> Iterator[Line]:
    """Table 2: surfaces from predicted normals and from those of a PCA, at the same points.

    The PCA's normals get the signs of the predicted ones: what is compared is their directions.
    """
    for name, key, upsample, missing in (
        _source(served, served),
        _of(folder, Trained("paper", ratio), ratio),
    ):
        if upsample is None:
            yield missing
            continue
        # One network run serves all lines of a shape: the store asks shape by shape.
        dense = _remembered(upsample)
        for count in PCA_COUNTS:
            yield Line(
                f"{name}: PCA-{count}",
                ratio,
                store.row(f"{key} PCA-{count} x{ratio}", _with_pca(dense, count), ratio),
                printed=printed.NORMALS[f"PCA-{count}"],
            )
        row = store.row(f"{key} x{ratio}", dense, ratio)
        yield Line(f"{name}: predicted", ratio, row, printed=printed.NORMALS["predicted"])
    line = _trained(store, folder, Trained("pu_net_m", ratio), ratio)
    yield replace(line, printed=printed.NORMALS["pu_net_m"])


def ablation(store: RowStore, folder: Path, ratio: int = 8) -> Iterator[Line]:
    """Table 3: the paper's network without one part each, and whole; then ours.

    All were trained for this table: the full model of ours is not the served one, but one of an
    equal budget.
    """
    for recipe in (*ABLATIONS, "paper"):
        line = _trained(store, folder, Trained(recipe, ratio), ratio)
        name = "full model" if recipe == "paper" else line.method
        yield replace(line, method=name, printed=printed.ABLATION[recipe])
    for recipe in (*SERVED, "standard"):
        line = _trained(store, folder, Trained(recipe, None), ratio)
        name = "full model" if recipe == "standard" else line.method
        yield replace(line, method=f"ours, {name}")


def _ear(store: RowStore, folder: Path, ratio: int) -> Line:
    line = Line(LABELS["ear"], ratio, None, printed=printed.COMPARISON.get(("ear", ratio)))
    clouds = folder / f"ear_x{ratio}"
    if not clouds.is_dir():
        return replace(line, why=f"no clouds yet: `python -m benchmarks.ear SAMPLES {folder}`")
    # Only stored files are read here, so no time is reported.
    row = replace(store.row(f"ear x{ratio}", stored(clouds), ratio), seconds=math.nan)
    return replace(line, row=row)


def _trained(store: RowStore, folder: Path, which: Trained, ratio: int) -> Line:
    if reason := which.impossible():
        return Line(_label(which.recipe), ratio, None, reason)
    name, key, method, missing = _of(folder, which, ratio)
    if method is None:
        return missing
    card = which.card(folder)
    assert card is not None
    return Line(
        name,
        ratio,
        store.row(f"{key} x{ratio}", method, ratio),
        megabytes=megabytes(card),
        budget=_budget(card),
        command=which.command(folder, card["training"]["steps"]),
    )


def _served(store: RowStore, served: str, ratio: int) -> Line:
    name, key, method, _ = _source(served, served)
    assert method is not None
    card = read_card(served)
    return Line(
        name,
        ratio,
        store.row(f"{key} x{ratio}", method, ratio),
        megabytes=megabytes(card),
        budget=_budget(card),
        command=card["training"]["command"],
    )


_Source = tuple[str, str, Method | None, Line]


def _label(recipe: str) -> str:
    """As tables call a recipe; ablations of the served network as those of the paper's."""
    return LABELS[recipe.replace("standard", "paper")]


def _of(folder: Path, which: Trained, ratio: int) -> _Source:
    path = which.weights(folder)
    label = _label(which.recipe)
    if not path.exists():
        why = f"not trained yet: `{which.command(folder)}`"
        return label, "", None, Line(label, ratio, None, why)
    return _source(str(path), label)


def _source(weights: str, label: str) -> _Source:
    """Return label, store key, method and empty line of weights. The key contains their sha256."""
    key = f"{label} {read_card(weights)['sha256'][:12]}"
    label = f"ours (`{label}`)" if label == weights else label
    loaded: list[Upsampler] = []

    def method(cloud: Cloud, ratio: float) -> Cloud:
        if not loaded:
            loaded.append(Upsampler(weights))
        return loaded[0](cloud, ratio).cloud

    return label, key, method, Line(label, 0, None)


def _budget(card: dict[str, Any]) -> str:
    training = card["training"]
    return f"{training['steps']:,} steps, {training['hours']:.1f} h"


def _remembered(method: Method) -> Method:
    """The same method, which does not run twice for the same points."""
    known: dict[tuple[bytes, float], Cloud] = {}

    def remembered(cloud: Cloud, ratio: float) -> Cloud:
        key = (cloud.points.tobytes(), ratio)
        if key not in known:
            known[key] = method(cloud, ratio)
        return known[key]

    return remembered


def _with_pca(method: Method, neighbours: int) -> Method:
    """The points of a method with normals of a PCA, their signs those of the method's own."""

    def with_pca(cloud: Cloud, ratio: float) -> Cloud:
        dense = method(cloud, ratio)
        assert dense.normals is not None
        found = pca_normals(dense.points.astype(np.float64), neighbours)
        sign = np.where((found * dense.normals).sum(axis=1, keepdims=True) < 0, -1, 1)
        return replace(dense, normals=(sign * found).astype(np.float32))

    return with_pca
