# SPDX-License-Identifier: Apache-2.0
"""``pugeo average``: weights between those before and after a training."""

from pathlib import Path
from typing import Annotated

import typer

from pugeo_model.cli.display import say

__all__ = ["average"]


def average(
    first: Annotated[str, typer.Argument(help="Released weights, or a .safetensors file.")],
    second: Annotated[str, typer.Argument(help="Weights that were trained on from the first.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The .safetensors file to write.")],
    share: Annotated[float, typer.Option(help="Of the second weights, 0 to 1.")] = 0.5,
) -> None:
    """Average two sets of weights of one network; the card is written beside them."""
    from pugeo_model.training.average import average as write

    write(first, second, share, out)
    say(f"weights in {out}, their card beside them")
