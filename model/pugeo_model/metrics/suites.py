# SPDX-License-Identifier: Apache-2.0
"""Suites of the evaluation whose inputs are made from the meshes: sensors, denoising, normals."""

import json
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

from pugeo_model.metrics.evaluation import Truth, mean_row, truths
from pugeo_model.metrics.tables import table
from pugeo_model.upsampler import Upsampler

__all__ = ["SUITES", "evaluate_suite"]

Rows = Callable[[Upsampler, Truth], Iterator[tuple[str, str, dict[str, float]]]]
"""Of a suite: measures one shape, and yields an input, a method and the measured columns."""

SUITES = {
    "sensors": "pugeo_model.metrics.sensor_suite",
    "denoising": "pugeo_model.metrics.denoising_suite",
    "normals": "pugeo_model.metrics.normals_suite",
}
"""Suite -> its module, which is imported only if it is asked for: sensors need the train extra."""


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
        tick: called after each row with a label, the number of completed shapes and of all.

    Raises:
        ModuleNotFoundError: a library is not installed.
        FileNotFoundError: there are no meshes.
    """
    rows: Rows = import_module(SUITES[suite]).rows
    upsampler, shapes = Upsampler(model), list(truths(meshes))
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for done, truth in enumerate(shapes):
        for condition, method, row in rows(upsampler, truth):
            found.setdefault((condition, method), {})[truth.name] = row
            tick(f"{truth.name} {condition} {method}", done, len(shapes))
    if out:
        text = json.dumps({"/".join(key): by_shape for key, by_shape in found.items()}, indent=1)
        out.write_text(text + "\n", "utf-8")
    means = ((key, mean_row(list(by_shape.values()))) for key, by_shape in found.items())
    return table(means, ("input", "method"))
