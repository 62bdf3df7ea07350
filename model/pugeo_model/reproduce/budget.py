# SPDX-License-Identifier: Apache-2.0
"""The cost of training: quality over hours, and the hours of the paper's own schedule."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["PAPER_STEPS", "draw_curves", "full_schedule"]

PAPER_STEPS = 800 * 300
"""Steps of the paper's 800 epochs. It does not say how long an epoch is; its authors' program
draws 300 batches of 8 patches an epoch."""


def full_schedule(card: Mapping[str, Any]) -> str:
    """One sentence: measured steps and hours, and the hours of 800 epochs at the same speed."""
    training = card["training"]
    steps, hours = training["steps"], training["hours"]
    whole = hours / steps * PAPER_STEPS
    return (
        f"{steps:,} steps took {hours:.1f} h on {training['hardware']}; the paper's 800 epochs,"
        f" {PAPER_STEPS:,} steps, would take {whole:,.0f} h at that speed"
    )


def draw_curves(logs: Mapping[str, Path], target: Path) -> None:
    """Draw validation losses over hours of training, a line for each log.

    Args:
        logs: label -> ``log.csv`` of a run that was validated.
        target: a ``.png`` file.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    columns = {
        "val_chamfer": "Chamfer distance of patches, radii",
        "val_refined_normal": "normal loss",
    }
    figure, axes = plt.subplots(1, len(columns), figsize=(10, 3.6), layout="constrained")
    for axis, (column, title) in zip(axes, columns.items(), strict=True):
        for label, path in logs.items():
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            if rows and column in rows[0]:
                hours = [float(row["hours"]) for row in rows]
                axis.plot(hours, [float(row[column]) for row in rows], label=label)
        axis.set(title=title, xlabel="hours", yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend()
    figure.savefig(target, dpi=110)
    plt.close(figure)
