# SPDX-License-Identifier: Apache-2.0
"""``pugeo samples``: inputs and references for ``pugeo evaluate``."""

from pathlib import Path
from typing import Annotated

import typer

from pugeo_model.cli.display import Display, say
from pugeo_model.cli.tasks import CommandError, needed_extra

__all__ = ["samples"]


def samples(
    meshes: Annotated[Path, typer.Argument(help="Folder of triangle meshes of any size.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder that gets meshes/, inputs/ and gt/.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Each seed gives other samples.")] = 0,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only.")] = False,
) -> None:
    """Sample meshes as `pugeo evaluate` needs it: sparse inputs and dense references."""
    try:
        from pugeo_model.metrics.samples import write_samples
    except ModuleNotFoundError as missing:
        raise needed_extra(missing, "evaluate") from missing
    if not meshes.is_dir():
        raise CommandError(f"{meshes} is no folder: give a folder of meshes")
    if out.exists() and not out.is_dir():
        raise CommandError(f"{out} is a file: give a folder")
    done = 0
    try:
        with Display(quiet=quiet) as display:
            for name, done, total in write_samples(meshes, out, seed):
                display.update(name, done / total)
    except ValueError as error:
        raise CommandError(str(error)) from error
    if not quiet:
        say(f"samples of {done} meshes in {out}")
        say(f"pugeo evaluate --meshes {out / 'meshes'} --samples {out}")
