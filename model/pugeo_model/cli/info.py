# SPDX-License-Identifier: Apache-2.0
"""``pugeo info``: the content of a file, and the work that it would be."""

import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pugeo_model.cli.display import say
from pugeo_model.cli.inputs import expand
from pugeo_model.cli.summary import FAILED, SOME_FAILED, count_dropped
from pugeo_model.cli.tasks import label
from pugeo_model.errors import CloudError

if TYPE_CHECKING:
    from pugeo_model.cloud import Cloud
    from pugeo_model.plan import Plan

__all__ = ["describe", "info"]

_SAMPLED = 20_000  # points whose spacing is measured


def info(
    sources: Annotated[
        list[Path], typer.Argument(help="Files, folders, patterns such as '*.laz'; - is stdin.")
    ],
    ratio: Annotated[float, typer.Option("-R", "--ratio", help="Of the work described.")] = 4.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON for each file.")
    ] = False,
) -> None:
    """Describe clouds: points, bounds, spacing, noise, attributes, and what would be done."""
    from pugeo_model.kernel_cache import compile_kernels
    from pugeo_model.options import Options

    options = Options(ratio)
    found = expand(sources)
    compile_kernels(say)
    failed = 0
    for number, each in enumerate(found):
        name = label(each.path)
        try:
            told = {"file": name, **describe(each.path, options)}
        except (CloudError, OSError) as error:
            failed += 1
            reason = (
                error.message if isinstance(error, CloudError) else error.strerror or str(error)
            )
            if as_json:
                sys.stdout.write(json.dumps({"file": name, "error": reason}) + "\n")
            say(f"error: {name}: {reason}", style="red")
            continue
        text = json.dumps(told) if as_json else ("\n" if number else "") + _text(told)
        sys.stdout.write(text + "\n")
    if failed:
        raise typer.Exit(SOME_FAILED if len(found) > 1 else FAILED)


def describe(path: Path | None, options: Any) -> dict[str, Any]:
    """Read a cloud and describe it as JSON-able values.

    Args:
        path: the file, ``None`` for standard input.
        options: an ``Options`` of the work described.

    Returns:
        ``format``, ``points``, ``bounds``, ``attributes``, ``notes`` and so on. ``work`` says what
        upsampling would do, or ``problem`` why it is not possible.

    Raises:
        CloudError, OSError: see `pugeo_model.formats.read`.
    """
    from pugeo_model import formats
    from pugeo_model.attributes import mark_labels
    from pugeo_model.plan import make_plan
    from pugeo_model.prepare import prepare

    cloud = formats.read(path or sys.stdin.buffer)
    assert cloud.source is not None
    told: dict[str, Any] = {
        "format": cloud.source.format,
        **({} if path is None else {"bytes": path.stat().st_size}),
        "points": len(cloud),
        "coordinates": str(cloud.points.dtype),
        **_bounds(cloud),
        "attributes": _attributes(mark_labels(cloud)),
        "crs": cloud.source.crs,
        "viewpoints": [] if cloud.viewpoints is None else cloud.viewpoints.tolist(),
    }
    try:
        plan = make_plan(cloud, options)
    except CloudError as error:
        return {**told, "notes": list(cloud.notes), "problem": error.message}
    noise = prepare(plan.tile(0)).noise if plan.noise is None else plan.noise
    return {
        **told,
        **_measured(plan, noise),
        "notes": plan.report["notes"],
        "work": _work(plan, noise),
    }


def _bounds(cloud: "Cloud") -> dict[str, Any]:
    """Smallest and largest finite coordinates, and their differences."""
    import numpy as np

    finite = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
    if not len(finite):
        return {"bounds": None, "size": None}
    low, high = finite.min(axis=0), finite.max(axis=0)
    return {"bounds": [low.tolist(), high.tolist()], "size": (high - low).tolist()}


def _attributes(cloud: "Cloud") -> dict[str, dict[str, str]]:
    """Type and treatment of each attribute."""
    found: dict[str, dict[str, str]] = {}
    if cloud.normals is not None:
        found["normals"] = {"type": str(cloud.normals.dtype), "becomes": "sides of new normals"}
    if cloud.colors is not None:
        found["colors"] = {"type": str(cloud.colors.dtype), "becomes": "interpolated"}
    for name, values in cloud.scalars.items():
        label = values.dtype.kind != "f" or name in cloud.labels
        becomes = "that of the nearest point" if label else "interpolated"
        found[name] = {"type": str(values.dtype), "becomes": becomes}
    return found


def _measured(plan: "Plan", noise: float) -> dict[str, Any]:
    """Spacing with its spread, and noise, in units of the cloud."""
    import numpy as np
    from scipy.spatial import cKDTree

    from pugeo_model.geometry.neighbours import SPACING_NEIGHBOURS, knn, spacing

    points, scale = plan.points, plan.normalisation.scale
    sample = points[:: max(1, len(points) // _SAMPLED)]
    count = min(SPACING_NEIGHBOURS + 1, len(points))
    near = spacing(knn(cKDTree(points), sample, count)[0][:, 1:].astype(np.float32)) * scale
    low, middle, high = (float(value) for value in np.quantile(near, [0.1, 0.5, 0.9]))
    return {
        "spacing": {"median": middle, "p10": low, "p90": high},
        "noise": {"spacings": noise, "units": noise * middle},
    }


def _work(plan: "Plan", noise: float) -> dict[str, Any]:
    """The work of upsampling, as it is planned."""
    from pugeo_model.formats import output_format
    from pugeo_model.tuning import TUNING

    report = plan.report
    assert plan.cloud.source is not None
    return {
        "dropped": report["dropped"],
        "ratio": report["ratio"],
        "points_out": report["points_out"],
        "denoised": bool(noise > TUNING.noise_threshold and not plan.keeps_input),
        "orient": report["orient"],
        "tiles": report["tiles"],
        "patches": report["patches"],
        "format": output_format(plan.cloud.source.format),
    }


def _text(told: dict[str, Any]) -> str:
    """The description as lines for a person."""
    lines = [f"{told['file']}: {told['format']}, {told['points']:,} points, {told['coordinates']}"]

    def add(name: str, value: str) -> None:
        lines.append(f"  {name:<12}{value}")

    if told["bounds"] is not None:
        add("from", _triple(told["bounds"][0]))
        add("to", _triple(told["bounds"][1]))
        add("size", _triple(told["size"]))
    if "spacing" in told:
        median, low, high = (told["spacing"][name] for name in ("median", "p10", "p90"))
        add("spacing", f"{median:.4g} (80 % of the points from {low:.4g} to {high:.4g})")
        add("noise", f"{told['noise']['units']:.2g}, {told['noise']['spacings']:.2f} spacings")
    for name, each in told["attributes"].items():
        add("attribute", f"{name} ({each['type']}): {each['becomes']}")
    add("CRS", _crs_name(told["crs"]))
    for position in told["viewpoints"][:3]:
        add("viewpoint", _triple(position))
    for note in told["notes"]:
        add("note", note)
    if "problem" in told:
        add("problem", told["problem"])
        return "\n".join(lines)
    work = told["work"]
    add(
        "upsampling",
        f"{work['points_out']:,} points at -R {work['ratio']:.4g}, as {work['format']}",
    )
    if dropped := count_dropped(work["dropped"]):
        add("", f"drops {dropped}")
    if work["denoised"]:
        add("", "removes noise first")
    add("", f"normals: {work['orient']}; {work['tiles']} tiles, {work['patches']} patches")
    return "\n".join(lines)


def _triple(values: list[float]) -> str:
    return ", ".join(f"{value:.10g}" for value in values)


def _crs_name(wkt: str | None) -> str:
    """The name in a WKT, or that there is none."""
    found = re.search(r'\["([^"]+)"', wkt or "")
    return "none" if not wkt else found[1] if found else wkt[:80]
