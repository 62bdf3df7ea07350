# SPDX-License-Identifier: Apache-2.0
"""Rows of the tables: one method on all validation shapes, kept on disk shape by shape."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read
from pugeo_model.metrics.evaluation import (
    Truth,
    mean_row,
    measure,
    measure_surface,
    reference,
)
from pugeo_model.metrics.reconstruction import reconstruct

__all__ = ["Row", "RowStore", "Setting"]

_POINTS = 5000  # M of Tables 1 to 3


@dataclass(frozen=True, eq=False)
class Setting:
    """The inputs and shapes of the measurement.

    Attributes:
        shapes: true surfaces.
        samples: folder with ``inputs/NAME_5000.ply`` and, for some R, ``gt/NAME_COUNT.ply``.
        surfaces: reconstruct surfaces too, which takes most of the time.
    """

    shapes: Sequence[Truth]
    samples: Path
    surfaces: bool = True


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        columns: mean over shapes; empty where the method cannot do it.
        seconds: of the processor for upsampling, all shapes together; NaN where another program
            did it.
        spent: of the processor for upsampling, reconstruction and measuring.
    """

    columns: dict[str, float]
    seconds: float
    spent: float


class RowStore:
    """Measures methods, and keeps every shape's figures in one JSON file.

    A key that is known is not measured again: so a run that was cut off goes on, and a new network
    costs its own rows alone. A key has to name all that a row depends on.

    Args:
        path: of the file.
        setting: what is measured on.
        tick: called with a key and the shape at hand.
        anew: measure known keys again.
    """

    def __init__(
        self,
        path: Path,
        setting: Setting,
        tick: Callable[[str, str], None] = lambda _key, _shape: None,
        *,
        anew: bool = False,
    ) -> None:
        self._path, self._setting, self._tick, self._anew = path, setting, tick, anew
        self._known: dict[str, dict[str, dict[str, float]]] = {}
        if path.exists():
            self._known = json.loads(path.read_text("utf-8"))
        self._fresh: set[str] = set()

    def row(self, key: str, method: Callable[[Cloud, float], Cloud], ratio: int) -> Row:
        """Measure ``method`` on all shapes at this ratio.

        Args:
            key: names method, weights and ratio.
            method: input and ratio to a dense cloud with normals.
            ratio: R.
        """
        if self._setting.surfaces:
            key = f"{key} surfaces"
        if self._anew and key not in self._fresh:
            self._known.pop(key, None)
        self._fresh.add(key)
        known = self._known.setdefault(key, {})
        for truth in self._setting.shapes:
            if truth.name in known:
                continue
            self._tick(key, truth.name)
            begun = time.process_time()
            cloud = read(self._setting.samples / "inputs" / f"{truth.name}_{_POINTS}.ply")
            dense = method(cloud, ratio)
            seconds = time.process_time() - begun
            figures = self._measure(truth, dense, ratio)
            spent = time.process_time() - begun
            known[truth.name] = {**figures, "seconds": seconds, "spent": spent}
            self._save()
        rows = [known[truth.name] for truth in self._setting.shapes]
        means = mean_row(rows)
        seconds, spent = means.pop("seconds"), means.pop("spent")
        return Row(means, seconds * len(rows), spent * len(rows))

    def _measure(self, truth: Truth, dense: Cloud, ratio: int) -> dict[str, float]:
        points = dense.points.astype(np.float64)
        true = reference(truth, self._setting.samples, ratio * _POINTS)
        figures = measure(points, dense.normals, true, truth)
        if self._setting.surfaces and dense.normals is not None:
            figures |= measure_surface(reconstruct(points, dense.normals), truth)
        return figures

    def _save(self) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        partial = self._path.with_suffix(".partial")
        partial.write_text(json.dumps(self._known, indent=1) + "\n", "utf-8")
        partial.replace(self._path)
