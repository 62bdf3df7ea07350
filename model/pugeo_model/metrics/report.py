# SPDX-License-Identifier: Apache-2.0
"""The evaluation as tables: for a person, for a program, for the model card."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pugeo_model.metrics.evaluation import CASES, COLUMNS, evaluate, limit, mean_row
from pugeo_model.pipeline import Upsampler
from pugeo_model.weights import locate

__all__ = ["evaluate_all", "table"]


def evaluate_all(
    model: str,
    meshes: Path,
    samples: Path,
    out: Path | None,
    *,
    card: bool,
    tick: Callable[[str, int, int], None],
) -> str:
    """Measure all cases and their limit.

    Args:
        model: released weights or the path of a ``.safetensors`` file.
        meshes: folder of ``NAME.ply``.
        samples: folder with ``inputs/`` and ``gt/``.
        out: where all rows go as JSON, or ``None``.
        card: write the means into the card beside the weights.
        tick: called with a label, rows done and rows in all.

    Returns:
        A Markdown table of means over shapes.
    """
    upsampler = Upsampler(model)
    total = 2 * len(CASES) * len(list(meshes.glob("*.ply")))
    rows: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    done = 0
    sources = {
        "ours": evaluate(lambda cloud, ratio: upsampler(cloud, ratio).cloud, meshes, samples),
        "limit": limit(meshes, samples),
    }
    for source, found in sources.items():
        for case, shape, row in found:
            rows.setdefault(case.name, {}).setdefault(source, {})[shape] = row
            done += 1
            tick(f"{source} {case.name}", done, total)
    means = {
        case: {source: mean_row(list(shapes.values())) for source, shapes in sources.items()}
        for case, sources in rows.items()
    }
    if out:
        out.write_text(json.dumps({"means": means, "shapes": rows}, indent=1) + "\n", "utf-8")
    if card:
        _into_card(locate(model), means)
    return table(means)


def table(means: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown: one line a case and source."""
    lines = [
        "| input | method | " + " | ".join(COLUMNS) + " |",
        "|---" * (len(COLUMNS) + 2) + "|",
    ]
    for case, sources in means.items():
        for source, row in sources.items():
            cells = (f"{row[name]:.4g}" if name in row else "" for name in COLUMNS)
            lines.append(f"| {case} | {source} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _into_card(path: Path, means: dict[str, dict[str, dict[str, float]]]) -> None:
    place = path.with_suffix(".json")
    card: dict[str, Any] = json.loads(place.read_text("utf-8"))
    card["quality"] = {
        case: {name: round(value, 4) for name, value in sources["ours"].items() if name in COLUMNS}
        for case, sources in means.items()
    }
    place.write_text(json.dumps(card, indent=2) + "\n", "utf-8")
