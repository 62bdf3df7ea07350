# SPDX-License-Identifier: Apache-2.0
"""Suites of the evaluation whose inputs are made from the meshes: sensors, denoising, normals."""

import json
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

from pugeo_model.metrics.evaluation import Truth, mean_row, truths
from pugeo_model.metrics.tables import table
from pugeo_model.upsampler import Upsampler

__all__ = ["SUITES", "evaluate_suite"]

SUITES = ("sensors", "denoising", "normals")

Rows = Callable[[Upsampler, Truth], Iterator[tuple[str, str, dict[str, float]]]]
_MODULES = {
    "sensors": "sensor_suite",
    "denoising": "denoising_suite",
    "normals": "normals_suite",
}


def evaluate_suite(
    suite: str,
    model: str,
    meshes: Path,
    out: Path | None = None,
    tick: Callable[[str, int, int], None] = lambda _label, _done, _total: None,
) -> str:
    """Measure a suite on all meshes; returns a Markdown table of means over shapes.

    Args:
        suite: one of `SUITES`.
        model: name of released weights or path of a ``.safetensors`` file.
        meshes: folder of ``NAME.ply``, longest side 1.
        out: JSON file for all rows.
        tick: called with a label, the number of completed shapes and of all shapes.

    Raises:
        ModuleNotFoundError: a library is not installed.
        FileNotFoundError: there are no meshes.
    """
    rows: Rows = import_module(f"pugeo_model.metrics.{_MODULES[suite]}").rows
    upsampler, shapes = Upsampler(model), list(truths(meshes))
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for done, truth in enumerate(shapes):
        for condition, method, row in rows(upsampler, truth):
            found.setdefault((condition, method), {})[truth.name] = row
            tick(f"{truth.name} {condition} {method}", done, len(shapes))
    if out:
        text = json.dumps({"/".join(key): by_shape for key, by_shape in found.items()}, indent=1)
        out.write_text(text + "\n", "utf-8")
    return _means_table(found)


def _means_table(found: dict[tuple[str, str], dict[str, dict[str, float]]]) -> str:
    lines: Sequence[tuple[tuple[str, ...], dict[str, float]]] = [
        (key, mean_row(list(by_shape.values()))) for key, by_shape in found.items()
    ]
    return table(lines, ("input", "method"))
