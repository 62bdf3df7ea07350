# SPDX-License-Identifier: Apache-2.0
"""``pugeo reproduce``: the tables of the paper."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import TextColumn

from pugeo_model.cli.display import progress_bar, say, stopped_training
from pugeo_model.cli.tasks import needed_extra

__all__ = ["reproduce"]


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
        raise needed_extra(missing, "evaluate") from missing
    unknown = [name for name in part or () if name not in PARTS]
    if unknown:
        raise typer.BadParameter(f"no part {unknown[0]!r}: give one of {', '.join(PARTS)}")
    with progress_bar(TextColumn("{task.fields[info]}")) as bar:
        task = bar.add_task("reproduce", total=None, info="")
        if train_on is not None and not train_missing(
            train_on,
            meshes,
            networks,
            needed(),
            steps,
            lambda name, step, words: bar.update(
                task, description=name, info=f"step {step:,} {words}"
            ),
        ):
            raise stopped_training(networks)
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
    say(f"written to {out}")
