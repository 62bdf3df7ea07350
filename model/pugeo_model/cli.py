# SPDX-License-Identifier: Apache-2.0
"""The command `pugeo`. Other packages add subcommands by entry points in `pugeo.commands`."""

import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

try:
    import typer
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
except ModuleNotFoundError as missing:
    raise SystemExit(
        f"the pugeo command needs {missing.name}, which comes with: pip install 'pugeo[model]'"
    ) from missing

from pugeo_model import __version__
from pugeo_model.errors import CloudError

__all__ = ["app", "main"]

app = typer.Typer(
    help="Point cloud upsampling with normals.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_console = Console(stderr=True)


def _bar(*columns: str) -> Progress:
    return Progress(
        TextColumn("{task.description:<10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        *(TextColumn(column) for column in columns),
        console=_console,
        transient=True,
    )


def _numbers(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter("must be three numbers x,y,z") from None
    return x, y, z


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command()
def upsample(
    source: Annotated[
        Path, typer.Argument(help="PLY, LAS, LAZ, PCD, E57, PTX, XYZ, NPY, NPZ or JSON file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Output; its suffix is its format.")],
    ratio: Annotated[float, typer.Option("-R", "--ratio", help="1 to 32, any number.")] = 4.0,
    n_points: Annotated[int | None, typer.Option(help="Points wanted, instead of -R.")] = None,
    orient: Annotated[
        str, typer.Option(help="Signs of normals: auto, input, viewpoint, mst, outward, none.")
    ] = "auto",
    viewpoint: Annotated[str | None, typer.Option(help="Sensor position x,y,z.")] = None,
    seed: Annotated[int, typer.Option(help="Each seed gives another sample.")] = 0,
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Keep the input points unchanged, also noisy ones.")
    ] = False,
    model: Annotated[str, typer.Option(help="Released weights or a .safetensors file.")] = (
        "standard"
    ),
    format: Annotated[
        str | None, typer.Option(help="Output format, such as ply-ascii or laz [from the suffix].")
    ] = None,
) -> None:
    """Write a cloud with R times as many points, each with a normal."""
    from pugeo_model.formats import WRITABLE, read, write, written_as
    from pugeo_model.formats import dropped as attributes_dropped
    from pugeo_model.kernel_cache import compile_kernels
    from pugeo_model.options import Options
    from pugeo_model.upsampler import Upsampler

    where = _numbers(viewpoint)
    # Invalid options are an error before the work, not after it.
    Options(ratio, n_points, orient, where, seed, keep_input)
    kind = format or written_as(out)
    if kind not in WRITABLE:
        raise typer.BadParameter(f"must be one of {', '.join(WRITABLE)}", param_hint="--format")
    cloud = read(source)
    compile_kernels(_console.print)
    upsampler = Upsampler(model)
    with _bar() as bar:
        task = bar.add_task("read", total=1)
        result = upsampler(
            cloud,
            ratio,
            n_points=n_points,
            orient=orient,
            viewpoint=where,
            seed=seed,
            keep_input=keep_input,
            progress=lambda stage, done, total: bar.update(
                task, description=stage, completed=done, total=total
            ),
        )
    write(result.cloud, out, format=kind)
    report = result.report
    dropped = report["dropped"]
    _console.print(
        f"{report['points_used']:,} points -> {report['points_out']:,} points in {out}"
        f" (normals: {report['orient']})"
    )
    if any(dropped.values()):
        _console.print(
            f"dropped {dropped['non_finite']:,} non-finite and {dropped['duplicate']:,}"
            " duplicate points"
        )
    lost = attributes_dropped(result.cloud, kind)
    for note in [*report["notes"], *([lost] if lost else [])]:
        _console.print(f"note: {note}")


@app.command()
def models() -> None:
    """List the released weights."""
    from pugeo_model.weights import available, read_card

    for name in available():
        card = read_card(name)
        typer.echo(f"{name}  version {card['version']}  sha256 {card['sha256'][:16]}")


@app.command()
def train(
    meshes: Annotated[Path, typer.Argument(help="Folder of training meshes.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the run; resumed if used.")],
    val: Annotated[Path | None, typer.Option(help="Folder of meshes never trained on.")] = None,
    recipe: Annotated[
        str, typer.Option(help="Of released weights, by name, or your own .toml file.")
    ] = "standard",
    steps: Annotated[
        int | None, typer.Option(help="Length, instead of the recipe's; raise it to train on.")
    ] = None,
    ratio: Annotated[
        int | None, typer.Option(help="R of a patch network, instead of the recipe's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights and batches.")] = None,
    threads: Annotated[int | None, typer.Option(help="Torch threads.")] = None,
    start: Annotated[
        str | None, typer.Option(help="Weights to start from: released, or a .safetensors file.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of the weights [the recipe's].")] = None,
    every: Annotated[int, typer.Option(help="Steps between checkpoints.")] = 500,
) -> None:
    """Train on a folder of meshes; a run in the same folder is resumed exactly."""
    from dataclasses import replace

    try:
        from pugeo_model.training.recipes import read_recipe, with_ratio
        from pugeo_model.training.run import load_shapes, run
    except ModuleNotFoundError as missing:
        raise typer.BadParameter(
            f"this needs {missing.name}, which comes with: pip install 'pugeo[train]'"
        ) from missing

    chosen: dict[str, Any] = {"steps": steps, "seed": seed, "threads": threads, "start": start}
    wanted = replace(read_recipe(recipe), **{k: v for k, v in chosen.items() if v is not None})
    if ratio is not None:
        wanted = with_ratio(wanted, ratio)
    with _bar("{task.fields[info]}") as bar:
        task = bar.add_task("sample", total=None, info="")
        shapes = load_shapes(
            meshes, lambda done, total: bar.update(task, completed=done, total=total)
        )
        validation = load_shapes(val) if val else []
        bar.update(task, description="train", completed=0, total=wanted.steps)
        run(
            shapes,
            validation,
            meshes,
            wanted,
            out,
            name or Path(recipe).stem,
            recipe,
            every,
            tick=lambda step, info: bar.update(task, completed=step, info=info),
        )
    _console.print(f"weights, card, log and curves in {out}")


@app.command()
def evaluate(
    meshes: Annotated[Path, typer.Option(help="Folder of NAME.ply meshes, longest side 1.")],
    samples: Annotated[Path, typer.Option(help="Folder with inputs/ and gt/ samples of them.")],
    model: Annotated[str, typer.Option(help="Released weights or a .safetensors file.")] = (
        "standard"
    ),
    case: Annotated[
        list[str] | None, typer.Option(help="Only this input, such as '5000 x4'; repeatable.")
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
    try:
        from pugeo_model.metrics.evaluation import CASES
        from pugeo_model.metrics.report import evaluate_all, require

        require(surfaces=reconstruct, pictures=report is not None)
    except ModuleNotFoundError as missing:
        raise typer.BadParameter(
            f"this needs {missing.name}, which comes with: pip install 'pugeo[evaluate]'"
        ) from missing
    known = {each.name: each for each in CASES}
    unknown = [name for name in case or () if name not in known]
    if unknown:
        raise typer.BadParameter(f"no case {unknown[0]!r}: give one of {', '.join(known)}")
    with _bar() as bar:
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


@app.command()
def reproduce(
    meshes: Annotated[Path, typer.Option(help="Folder of NAME.ply meshes, longest side 1.")],
    samples: Annotated[Path, typer.Option(help="Folder with inputs/ and gt/ samples of them.")],
    networks: Annotated[
        Path, typer.Option(help="Folder of the trained networks and of all measured rows.")
    ] = Path("reproduction"),
    out: Annotated[Path, typer.Option("-o", "--out", help="The document.")] = Path("docs/paper.md"),
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Only comparison, normals, ablation, geometry or robustness; repeatable."
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="The served weights to compare with.")] = "standard",
    train_on: Annotated[
        Path | None, typer.Option(help="Train the missing networks on these meshes first.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Of each training, not the recipes'.")] = None,
    kitti: Annotated[Path | None, typer.Option(help="A Velodyne frame for the figure.")] = None,
    surfaces: Annotated[bool, typer.Option(help="Measure reconstructed surfaces too.")] = True,
    anew: Annotated[bool, typer.Option("--anew", help="Measure known rows again.")] = False,
) -> None:
    """Measure the tables and figures of the PUGeo-Net paper and write the document on them."""
    try:
        from pugeo_model.reproduce.run import PARTS, Reproduction
        from pugeo_model.reproduce.trained import needed, train_missing
    except ModuleNotFoundError as missing:
        raise typer.BadParameter(
            f"this needs {missing.name}, which comes with: pip install 'pugeo[evaluate]'"
        ) from missing
    unknown = [name for name in part or () if name not in PARTS]
    if unknown:
        raise typer.BadParameter(f"no part {unknown[0]!r}: give one of {', '.join(PARTS)}")
    with _bar("{task.fields[info]}") as bar:
        task = bar.add_task("reproduce", total=None, info="")
        if train_on is not None:
            train_missing(
                train_on,
                meshes,
                networks,
                needed(),
                steps,
                lambda name, step, words: bar.update(
                    task, description=name, info=f"step {step:,} {words}"
                ),
            )
        reproduction = Reproduction(
            meshes,
            samples,
            networks,
            model,
            out,
            kitti,
            surfaces=surfaces,
            anew=anew,
            tick=lambda key, shape: bar.update(task, description=key, info=shape),
        )
        reproduction.make(part or PARTS)
    _console.print(f"written to {out}")


for _entry in entry_points(group="pugeo.commands"):
    try:
        app.command(_entry.name)(_entry.load())
    except ModuleNotFoundError as _missing:
        # Without the extra of `serve` the other commands still work.
        _hint = f"{_entry.name} needs {_missing.name}: pip install 'pugeo[server]'"

        @app.command(_entry.name, help=_hint)
        def _unavailable(hint: str = typer.Option(_hint, hidden=True)) -> None:
            raise typer.BadParameter(hint)


def main() -> None:
    """Run the command line; an invalid input gives one line and not a traceback."""
    try:
        app()
    except CloudError as error:
        _console.print(f"error: {error.message}", style="red", markup=False, highlight=False)
        sys.exit(2)
    except FileNotFoundError as error:
        _console.print(f"error: {error}", style="red", markup=False, highlight=False)
        sys.exit(2)
