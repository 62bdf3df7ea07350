# SPDX-License-Identifier: Apache-2.0
"""Evaluation report of a model: Markdown tables, JSON, pictures, means for the model card."""

import json
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pugeo_model.metrics import baselines, reconstruction
from pugeo_model.metrics.evaluation import (
    CASES,
    COLUMNS,
    Case,
    Measured,
    Method,
    evaluate,
    limit,
    mean_row,
    truths,
)
from pugeo_model.metrics.tables import legend, table
from pugeo_model.upsampler import Upsampler
from pugeo_model.weights import locate, read_card

__all__ = ["Rows", "evaluate_all", "means_table", "require"]

Rows = dict[str, dict[str, dict[str, dict[str, float]]]]
"""Case -> method -> shape -> column -> value."""

_OURS, _LIMIT = "ours", "limit"
_MEANING = {
    _OURS: "the model",
    _LIMIT: "an independent Poisson-disk sample of the true mesh, with its normals",
    "plane": "PCA plane of 16 neighbours and our selection, without a network",
    "jet": "fitted quadric and our selection, without a network",
    "poisson": "screened Poisson reconstruction of the input, sampled evenly",
}


def require(*, surfaces: bool, pictures: bool) -> None:
    """Check that the libraries for the requested parts are installed, before the evaluation.

    Args:
        surfaces: surfaces will be reconstructed.
        pictures: pictures will be drawn.

    Raises:
        ModuleNotFoundError: a library is not installed.
    """
    if surfaces:
        reconstruction.library()
    if pictures:
        import matplotlib as mpl  # noqa: F401


def evaluate_all(
    model: str,
    meshes: Path,
    samples: Path,
    *,
    cases: Sequence[Case] = CASES,
    compare: bool = False,
    surfaces: bool = False,
    out: Path | None = None,
    report: Path | None = None,
    card: bool = False,
    tick: Callable[[str, int, int], None] = lambda _label, _done, _total: None,
) -> str:
    """Evaluate a model, the limit and optionally the baselines in all cases.

    Args:
        model: name of released weights or path of a ``.safetensors`` file.
        meshes: folder of ``NAME.ply``, longest side 1.
        samples: folder with ``inputs/`` and ``gt/``.
        cases: kinds of input and ratios.
        compare: evaluate methods without learning too; the reconstruction only if its library is
            installed.
        surfaces: reconstruct surfaces from the dense clouds and measure these too.
        out: JSON file for all rows.
        report: folder for ``report.md``, ``figures.json`` and pictures of the first case.
        card: write the means into the card beside the weights.
        tick: called with a label, the number of completed rows and of all rows.

    Returns:
        A Markdown table of means over shapes.

    Raises:
        ModuleNotFoundError: see :func:`require`.
        FileNotFoundError: a mesh or a sample is missing.
    """
    require(surfaces=surfaces, pictures=report is not None)
    if report:
        report.mkdir(parents=True, exist_ok=True)
    upsampler = Upsampler(model)
    shapes = list(truths(meshes))
    methods: dict[str, Method] = {_OURS: lambda cloud, ratio: upsampler(cloud, ratio).cloud}
    if compare:
        methods |= {"plane": baselines.plane, "jet": baselines.jet}
        if find_spec("pycolmap"):
            methods["poisson"] = baselines.poisson
    sources: dict[str, Iterable[Measured]] = {
        name: evaluate(method, shapes, samples, cases, surfaces=surfaces)
        for name, method in methods.items()
    }
    sources[_LIMIT] = limit(shapes, samples, cases, surfaces=surfaces)
    rows: Rows = {case.name: {source: {} for source in sources} for case in cases}
    done, total = 0, len(sources) * len(cases) * len(shapes)
    for source, found in sources.items():
        for measured in found:
            case, shape = measured.case.name, measured.truth.name
            rows[case][source][shape] = measured.row
            if report and source == _OURS and measured.case == cases[0]:
                _draw(measured, report)
            done += 1
            tick(f"{source} {case}", done, total)
    text = json.dumps({"means": _means(rows), "shapes": rows}, indent=1) + "\n"
    if out:
        out.write_text(text, "utf-8")
    if report:
        (report / "figures.json").write_text(text, "utf-8")
        (report / "report.md").write_text(_document(read_card(model), rows), "utf-8")
    if card:
        _write_card(locate(model), rows)
    return means_table(rows)


def means_table(rows: Rows) -> str:
    """Return a Markdown table of means over shapes, one line per case and method."""
    return table(
        (
            ((case, source), row)
            for case, sources in _means(rows).items()
            for source, row in sources.items()
        ),
        ("input", "method"),
    )


def _means(rows: Rows) -> dict[str, dict[str, dict[str, float]]]:
    return {
        case: {source: mean_row(list(shapes.values())) for source, shapes in sources.items()}
        for case, sources in rows.items()
    }


def _picture(shape: str) -> str:
    """Path of a picture, relative to the report."""
    return f"pictures/{shape}.png"


def _draw(measured: Measured, folder: Path) -> None:
    from pugeo_model.metrics.pictures import draw

    target = folder / _picture(measured.truth.name)
    target.parent.mkdir(parents=True, exist_ok=True)
    draw(measured, target)


def _document(card: dict[str, Any], rows: Rows) -> str:
    """Markdown of the report: means, each shape, pictures of the first case."""
    first = next(iter(rows.values()))
    methods = "\n".join(f"- {name}: {_MEANING[name]}" for name in first)
    parts = [
        f"# Quality of {card['name']} {card['version']}",
        f"Weights with SHA-256 `{card['sha256']}`. The unit of length is a shape's longest side.",
        legend(row for sources in rows.values() for row in sources[_OURS].values()),
        f"The methods:\n\n{methods}",
        "## Means over shapes",
        means_table(rows),
    ]
    for case, sources in rows.items():
        lines = (
            ((shape, source), row)
            for shape in sources[_OURS]
            for source, shapes in sources.items()
            for row in (shapes[shape],)
        )
        parts += [f"## {case}", table(lines, ("shape", "method"))]
    parts.append(f"## Pictures: {next(iter(rows))}")
    parts += [f"![{shape}]({_picture(shape)})" for shape in first[_OURS]]
    return "\n\n".join(parts) + "\n"


def _write_card(path: Path, rows: Rows) -> None:
    """Write the means of the model into the card beside its weights."""
    card_path = path.with_suffix(".json")
    card: dict[str, Any] = json.loads(card_path.read_text("utf-8"))
    card["quality"] = {
        case: {name: round(value, 4) for name, value in sources[_OURS].items() if name in COLUMNS}
        for case, sources in _means(rows).items()
    }
    card_path.write_text(json.dumps(card, indent=2) + "\n", "utf-8")
