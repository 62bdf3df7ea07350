# SPDX-License-Identifier: Apache-2.0
"""A complete training run: weights, model card, log and plot of the curves."""

import csv
import platform
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch

from pugeo_model import __version__
from pugeo_model.mesh.files import mesh_files
from pugeo_model.training.corpus import Shape, content_hash, default_cache, load_shape
from pugeo_model.training.patches.trainer import PatchTrainer
from pugeo_model.training.trainer import Recipe, Trainer
from pugeo_model.weights import save

__all__ = ["load_shapes", "plot_curves", "run"]


def load_shapes(folder: Path, tick: Callable[[int, int], None] | None = None) -> list[Shape]:
    """Load all shapes of a folder; samples are computed once and cached (``$PUGEO_CACHE``).

    Args:
        folder: folder of meshes.
        tick: called with the number of loaded shapes and of all shapes.
    """
    files = mesh_files(folder)
    shapes = []
    for done, path in enumerate(files):
        if tick:
            tick(done, len(files))
        shapes.append(load_shape(path, default_cache()))
    return shapes


def run(
    shapes: list[Shape],
    validation: list[Shape],
    meshes: Path,
    recipe: Recipe,
    folder: Path,
    name: str,
    recipe_name: str,
    every: int,
    tick: Callable[[int, str], None],
) -> bool:
    """Train and write ``NAME.safetensors``, its card, ``log.csv`` and ``curves.png``.

    Args:
        shapes: training shapes.
        validation: shapes for the validation loss; may be empty.
        meshes: folder of the training shapes, for the data hash.
        recipe: settings of the run.
        folder: folder of the run; an existing run there is resumed.
        name: name of the weights.
        recipe_name: argument of ``--recipe`` that repeats the run, for the model card.
        every: steps between checkpoints.
        tick: called after each step with the step and the last losses as text.

    Returns:
        Whether all steps are done; ``False`` after SIGTERM.
    """
    kind = Trainer if recipe.patches is None else PatchTrainer
    trainer = kind(shapes, recipe, folder, validation)
    losses = ""

    def write() -> None:
        plot_curves(folder / "log.csv", folder / "curves.png")
        save(
            trainer.net,
            model_card(trainer, meshes, name, recipe_name),
            folder / f"{name}.safetensors",
        )

    def report(_step: int, line: dict[str, float]) -> None:
        nonlocal losses
        shown = {key: line[key] for key in ("loss", "val_loss") if key in line}
        losses = "  ".join(f"{key} {value:.4f}" for key, value in shown.items())
        write()

    with _stopped_by_sigterm(trainer):
        trainer.run(every, report, lambda step: tick(step, losses))
    # Also if no step was left, as after a change of the name.
    write()
    return trainer.step >= recipe.steps


@contextmanager
def _stopped_by_sigterm(trainer: Trainer) -> Iterator[None]:
    """Let SIGTERM end the run after the current step, with a checkpoint."""

    def stop(_signal: int, _frame: Any) -> None:
        trainer.stopping = True

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def model_card(trainer: Trainer, meshes: Path, name: str, recipe_name: str) -> dict[str, Any]:
    """Describe weights and their training, so that they can be judged and reproduced."""
    recipe = trainer.recipe
    files = mesh_files(meshes)
    return {
        "name": name,
        "version": __version__,
        "ratio_range": [1, 32 if recipe.patches is None else trainer.net.ratio],
        "parameters": sum(value.numel() for value in trainer.net.parameters()),
        "training": {
            "command": (
                f"pugeo train {meshes.name} --out RUN --val VAL --recipe {Path(recipe_name).name}"
                + (f" --ratio {trainer.net.ratio}" if recipe.patches else "")
                + f" --steps {recipe.steps} --seed {recipe.seed} --threads {recipe.threads}"
                f" --name {name}" + (f" --start {Path(recipe.start).name}" if recipe.start else "")
            ),
            "recipe": recipe.to_json(),
            "steps": trainer.step,
            "hours": round(trainer.hours, 3),
            "hardware": f"{recipe.threads} thread(s) of a {platform.machine()} CPU",
            "torch": torch.__version__,
            "shapes": len(files),
            "data_sha256": content_hash(files),
            "licences": licences(meshes, {path.stem for path in files}),
        },
        "quality": {},
    }


def licences(meshes: Path, names: set[str]) -> dict[str, int]:
    """Count the training shapes by licence.

    Args:
        meshes: folder of the shapes; ``MANIFEST.tsv`` beside it has the columns ``name`` and
            ``licence``.
        names: names of the training shapes.

    Returns:
        Licence -> number of shapes; empty without a manifest.
    """
    manifest = meshes.parent / "MANIFEST.tsv"
    if not manifest.exists():
        return {}
    with manifest.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file, delimiter="\t")
        terms = Counter(row["licence"] for row in rows if row["name"] in names)
    return dict(terms.most_common())


def plot_curves(log: Path, picture: Path) -> None:
    """Plot the losses in ``log.csv`` over steps, training and validation."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    known = (
        *("loss", "coverage", "p2f", "refined_normal", "blended_p2f", "blended_normal"),
        *("chamfer", "coarse_normal", "repulsion"),
    )
    names = [name for name in known if name in rows[0]][:6]
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), layout="constrained")
    steps = [int(row["step"]) for row in rows]
    for axis, title in zip(axes.flat, names, strict=False):
        for column, label in ((title, "training"), (f"val_{title}", "validation")):
            if column in rows[0]:
                axis.plot(steps, [float(row[column]) for row in rows], label=label)
        axis.set(title=title.replace("_", " "), xlabel="step", yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes.flat[0].legend()
    figure.savefig(picture, dpi=110)
    plt.close(figure)
