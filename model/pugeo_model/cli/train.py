# SPDX-License-Identifier: Apache-2.0
"""``pugeo train``: a network of your own."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import TextColumn

from pugeo_model.cli.display import progress_bar, say, stopped_training
from pugeo_model.cli.tasks import needed_extra

__all__ = ["train"]


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
        raise needed_extra(missing, "train") from missing

    chosen: dict[str, Any] = {"steps": steps, "seed": seed, "threads": threads, "start": start}
    wanted = replace(read_recipe(recipe), **{k: v for k, v in chosen.items() if v is not None})
    if ratio is not None:
        wanted = with_ratio(wanted, ratio)
    with progress_bar(TextColumn("{task.fields[info]}")) as bar:
        task = bar.add_task("sample", total=None, info="")
        shapes = load_shapes(
            meshes, lambda done, total: bar.update(task, completed=done, total=total)
        )
        validation = load_shapes(val) if val else []
        bar.update(task, description="train", completed=0, total=wanted.steps)
        done = run(
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
    if not done:
        raise stopped_training(out)
    say(f"weights, card, log and curves in {out}")
