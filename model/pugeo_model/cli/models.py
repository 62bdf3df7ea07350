# SPDX-License-Identifier: Apache-2.0
"""``pugeo models``: the released weights."""

import typer

__all__ = ["models"]


def models() -> None:
    """List the released weights."""
    from pugeo_model.weights import available, read_card

    for name in available():
        card = read_card(name)
        typer.echo(f"{name}  version {card['version']}  sha256 {card['sha256'][:16]}")
