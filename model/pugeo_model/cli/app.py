# SPDX-License-Identifier: Apache-2.0
"""The commands of `pugeo` together, and their errors as one line."""

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated

from pugeo_model import __version__
from pugeo_model.errors import CloudError
from pugeo_model.install import install_hint

try:
    import typer

    from pugeo_model.cli.display import say
except ModuleNotFoundError as missing:
    raise SystemExit(
        f"the pugeo command needs {missing.name}: {install_hint('model')}"
    ) from missing

from pugeo_model.cli.average import average
from pugeo_model.cli.evaluate import evaluate
from pugeo_model.cli.info import info
from pugeo_model.cli.models import models
from pugeo_model.cli.reproduce import reproduce
from pugeo_model.cli.samples import samples
from pugeo_model.cli.summary import FAILED
from pugeo_model.cli.tasks import CommandError
from pugeo_model.cli.train import train
from pugeo_model.cli.upsample import upsample

__all__ = ["app", "main"]

app = typer.Typer(
    help="Point cloud upsampling with normals.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


for _command in (upsample, info, models, train, average, evaluate, samples, reproduce):
    app.command()(_command)


def _add(entry: EntryPoint) -> None:
    """Add the command of another package, or a command that says what is missing."""
    try:
        app.command(entry.name)(entry.load())
    except ModuleNotFoundError as missing:
        # Without the extra of `serve` the other commands still work.
        hint = f"{entry.name} needs {missing.name}: {install_hint('server')}"

        @app.command(entry.name, help=hint)
        def _unavailable() -> None:
            raise CommandError(hint)


for _entry in entry_points(group="pugeo.commands"):
    _add(_entry)


def main() -> None:
    """Run the command line; an invalid input gives one line and not a traceback."""
    try:
        app()
    except CloudError as error:
        say(f"error: {error.message}", style="red")
    except (CommandError, OSError) as error:
        say(f"error: {error}", style="red")
    else:
        return
    sys.exit(FAILED)
