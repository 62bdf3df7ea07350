# SPDX-License-Identifier: Apache-2.0
"""``pugeo evaluate``: the quality of a network on fixed samples."""

from pathlib import Path
from typing import Annotated

import typer

from pugeo_model.cli.display import progress_bar
from pugeo_model.cli.tasks import needed_extra

__all__ = ["evaluate"]


def evaluate(
    meshes: Annotated[Path, typer.Option(help="Folder of NAME.ply meshes, longest side 1.")],
    samples: Annotated[
        Path | None, typer.Option(help="Folder with inputs/ and gt/ samples of them.")
    ] = None,
    model: Annotated[str, typer.Option(help="Released weights or a .safetensors file.")] = (
        "standard"
    ),
    case: Annotated[
        list[str] | None, typer.Option(help="Only this input, such as '5000 x4'; repeatable.")
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(help="Inputs made from the meshes instead: sensors, denoising or normals."),
    ] = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Measure methods without learning too.")
    ] = False,
    reconstruct: Annotated[
        bool, typer.Option("--reconstruct", help="Measure reconstructed surfaces too.")
    ] = False,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="JSON of all figures.")] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder for a report with pictures of every shape.")
    ] = None,
    card: Annotated[bool, typer.Option(help="Write the means into the model card.")] = False,
) -> None:
    """Evaluate points and normals on fixed samples; the row `limit` is an ideal sample."""
    if suite is not None:
        given: dict[str, object] = {"--samples": samples, "--case": case, "--report": report}
        given |= {"--baselines": baselines, "--reconstruct": reconstruct, "--card": card}
        if useless := [flag for flag, value in given.items() if value]:
            raise typer.BadParameter(f"--suite makes its own inputs: leave out {useless[0]}")
        _evaluate_suite(suite, model, meshes, out)
        return
    if samples is None:
        raise typer.BadParameter("give --samples, or a --suite that makes its own inputs")
    try:
        from pugeo_model.metrics.evaluation import CASES
        from pugeo_model.metrics.report import evaluate_all, require

        require(surfaces=reconstruct, pictures=report is not None)
    except ModuleNotFoundError as missing:
        raise needed_extra(missing, "evaluate") from missing
    known = {each.name: each for each in CASES}
    unknown = [name for name in case or () if name not in known]
    if unknown:
        raise typer.BadParameter(f"no case {unknown[0]!r}: give one of {', '.join(known)}")
    with progress_bar() as bar:
        task = bar.add_task("evaluate", total=None)
        table = evaluate_all(
            model,
            meshes,
            samples,
            cases=[known[name] for name in case] if case else CASES,
            compare=baselines,
            surfaces=reconstruct,
            out=out,
            report=report,
            card=card,
            tick=lambda label, done, total: bar.update(
                task, description=label, completed=done, total=total
            ),
        )
    typer.echo(table)


def _evaluate_suite(suite: str, model: str, meshes: Path, out: Path | None) -> None:
    """Measure one of the suites that need no samples, and print its table."""
    try:
        from pugeo_model.metrics.suites import SUITES, evaluate_suite
    except ModuleNotFoundError as missing:
        raise needed_extra(missing, "evaluate") from missing
    if suite not in SUITES:
        raise typer.BadParameter(f"no suite {suite!r}: give one of {', '.join(SUITES)}")
    with progress_bar() as bar:
        task = bar.add_task(suite, total=None)
        try:
            table = evaluate_suite(
                suite,
                model,
                meshes,
                out,
                lambda label, done, total: bar.update(
                    task, description=label, completed=done, total=total
                ),
            )
        except ModuleNotFoundError as missing:
            raise needed_extra(missing, "train") from missing
    typer.echo(table)
