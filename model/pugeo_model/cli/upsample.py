# SPDX-License-Identifier: Apache-2.0
"""``pugeo upsample``: dense clouds of files, here or on a service."""

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from pugeo_model.cli.display import Display, say
from pugeo_model.cli.inputs import expand
from pugeo_model.cli.outputs import check_replaced, folder_of, make_tasks
from pugeo_model.cli.summary import Summary
from pugeo_model.cli.tasks import CommandError, Outcome, Task, TaskSettings, label

__all__ = ["upsample"]

_REQUESTS = 4  # at a time on a service: enough for two to four workers
_BYTES_PER_PROCESS = 1 << 20


def upsample(
    sources: Annotated[
        list[Path], typer.Argument(help="Files, folders, patterns such as '*.laz'; - is stdin.")
    ],
    out: Annotated[
        str, typer.Option("-o", "--out", help="File, folder/ for several, or - for stdout.")
    ],
    ratio: Annotated[
        float | None, typer.Option("-R", "--ratio", help="Points out per point in, 1 to 32 [4].")
    ] = None,
    n_points: Annotated[
        int | None, typer.Option(help="Number of points out, instead of -R.")
    ] = None,
    orient: Annotated[
        str, typer.Option(help="Signs of normals: auto, input, viewpoint, mst, outward, none.")
    ] = "auto",
    viewpoint: Annotated[
        str | None, typer.Option(help="Sensor position x,y,z; several as x,y,z;x,y,z.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Each seed gives another sample.")] = 0,
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Keep the input points unchanged, also noisy ones.")
    ] = False,
    density: Annotated[
        str, typer.Option(help="input: as dense as the scan; even: one spacing everywhere.")
    ] = "input",
    spacing: Annotated[
        float | None, typer.Option(help="Distance of points in the cloud's units, instead of -R.")
    ] = None,
    max_gap: Annotated[
        float | None, typer.Option(help="Largest distance from the input [1.25 local spacings].")
    ] = None,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="With -R 1: move the input points onto the surface.")
    ] = False,
    confidence: Annotated[
        bool, typer.Option("--confidence", help="Add the expected error of each point, a scalar.")
    ] = False,
    model: Annotated[
        str | None,
        typer.Option(
            help="Released weights or a .safetensors file; with --url a model of the service "
            "[standard]."
        ),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(help="Output format, such as ply-ascii or laz [suffix, or as the input]."),
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="Write a mesh of the dense cloud too, as PLY.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace outputs that exist.")
    ] = False,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Leave inputs whose output exists.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Files at a time [a process a core; 4 requests with --url]."),
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="Work on this service, with the key in PUGEO_API_KEY.")
    ] = None,
    jobs: Annotated[
        bool, typer.Option("--jobs", help="With --url: as jobs, which survive restarts.")
    ] = False,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON for each file, and a summary.")
    ] = False,
) -> None:
    """Write clouds with R times as many points, each with a normal.

    Exit status: 0; 1 for an unexpected error; 2 for an input or option that cannot be used; 3 if
    some of several inputs failed.
    """
    settings = TaskSettings(
        _checked_options(
            ratio=ratio,
            n_points=n_points,
            orient=orient,
            viewpoint=viewpoint,
            seed=seed,
            keep_input=keep_input,
            density=density,
            spacing=spacing,
            max_gap=max_gap,
            confidence=confidence,
            denoise=denoise,
        ),
        model,
        mesh,
    )
    _check_combination(
        sources, out, model=model, mesh=mesh, url=url, jobs=jobs, as_json=as_json,
        both=overwrite and skip_existing,
    )  # fmt: skip
    folder = folder_of(out, sources)
    tasks = make_tasks(expand(sources, folder), out, folder, format)
    skipped: list[Task] = []
    left: list[Task] = []
    for task in tasks:
        there = skip_existing and task.target is not None and task.target.is_file()
        (skipped if there else left).append(task)
    if not overwrite:
        check_replaced(left)
    if mesh is not None:
        _check_mesh(mesh, tasks, overwrite=overwrite)
    summary = Summary(tasks, quiet=quiet, as_json=as_json)
    for task in skipped:
        summary.add(Outcome(label(task.source), label(task.target), "skipped"))
    for task in left:
        if task.error is not None:
            error = task.error
            summary.add(Outcome(label(task.source), label(task.target), "failed", error=error))
    good = [task for task in left if task.error is None]
    with Display(quiet=quiet) as display:
        for outcome in _run(good, settings, workers, display, url=url, jobs=jobs) if good else ():
            summary.add(outcome)
    raise typer.Exit(summary.end())


def _run(
    tasks: list[Task],
    settings: TaskSettings,
    workers: int | None,
    display: Display,
    *,
    url: str | None,
    jobs: bool,
) -> Iterator[Outcome]:
    """Do tasks on a service, in processes, or in this one."""
    if url is not None:
        from pugeo_model.cli.remote import connect, run_remotely

        if any(task.format is None for task in tasks):
            raise typer.BadParameter(
                "a service cannot tell the format of stdin beforehand: give one",
                param_hint="--format",
            )
        with closing(connect(url, as_jobs=jobs)) as service:
            yield from run_remotely(service, tasks, settings, workers or _REQUESTS, display.update)
        return
    from pugeo_model.cli.local import MOST_PROCESSES, run_here, run_in_processes
    from pugeo_model.cpus import available_cpus
    from pugeo_model.kernel_cache import compile_kernels
    from pugeo_model.weights import locate

    locate(settings.weights)
    compile_kernels(say)
    # A process takes some seconds to start, which it must have work for.
    worth = 1 + sum(task.size for task in tasks) // _BYTES_PER_PROCESS
    count = min(workers or min(available_cpus(), worth), len(tasks), MOST_PROCESSES)
    if count == 1:
        yield from run_here(tasks, settings, display.update)
    else:
        yield from run_in_processes(tasks, settings, count, display.update)


def _checked_options(*, viewpoint: str | None, **options: Any) -> dict[str, Any]:
    """Options of the run that were given; invalid ones are an error before the work."""
    from pugeo_model.options import Options

    named = {"-R": "ratio", "--n-points": "n_points", "--spacing": "spacing"}
    sizes = [flag for flag, name in named.items() if options[name] is not None]
    if len(sizes) > 1:
        raise typer.BadParameter(
            f"give only one of -R, --n-points and --spacing, not {' and '.join(sizes)}"
        )
    if options["ratio"] is None:
        del options["ratio"]  # the default of `Options`, or of the service
    options["viewpoint"] = None if viewpoint is None else _positions(viewpoint)
    Options(**options)
    return options


def _positions(text: str) -> tuple[tuple[float, float, float], ...]:
    try:
        rows = [[float(number) for number in part.split(",")] for part in text.split(";")]
        return tuple((x, y, z) for x, y, z in rows)
    except ValueError:
        raise typer.BadParameter(
            "must be three numbers x,y,z, or several such, separated by semicolons",
            param_hint="--viewpoint",
        ) from None


def _check_combination(
    sources: list[Path],
    out: str,
    *,
    model: str | None,
    mesh: Path | None,
    url: str | None,
    jobs: bool,
    as_json: bool,
    both: bool,
) -> None:
    """Refuse options that exclude each other."""
    if both:
        raise typer.BadParameter("--overwrite and --skip-existing exclude each other")
    if jobs and url is None:
        raise typer.BadParameter("--jobs needs the address of a service: give --url")
    if url is not None and model is not None and model.endswith(".safetensors"):
        raise typer.BadParameter("a service has models by name: give --model a name with --url")
    if url is not None and mesh is not None:
        raise typer.BadParameter("--mesh is made here: leave it out with --url")
    if out == "-" and as_json:
        raise typer.BadParameter("--json and -o - both need stdout: give -o a file")
    if out == "-" and sys.stdout.isatty():
        raise typer.BadParameter("-o - would print the cloud on the terminal: redirect it")
    if Path("-") in sources and sys.stdin.isatty():
        raise typer.BadParameter("- reads a cloud from stdin, which is a terminal: redirect it")


def _check_mesh(mesh: Path, tasks: list[Task], *, overwrite: bool) -> None:
    """Refuse a mesh that cannot be made or written, before the work."""
    from pugeo_model.cli.mesh import check_library

    if len(tasks) > 1:
        raise CommandError("--mesh names one file: give one input at a time")
    if mesh.suffix.lower() != ".ply":
        raise CommandError(f"a mesh is written as PLY: name it .ply, not {mesh.name}")
    if not mesh.parent.is_dir():
        raise CommandError(f"the folder {mesh.parent} of the mesh does not exist: make it first")
    if mesh.exists() and not overwrite:
        raise CommandError(f"{mesh} exists: say --overwrite to replace it")
    same = [t for t in tasks for each in (t.source, t.target) if each is not None
            and each.resolve() == mesh.resolve()]  # fmt: skip
    if same:
        raise CommandError(f"{mesh} is the input or the output too: choose another name")
    check_library()
