# SPDX-License-Identifier: Apache-2.0
"""``python -m pugeo_service``: the command ``pugeo serve`` alone."""

# Worker processes import this module again under another name, so it must stay light.
if __name__ == "__main__":
    import typer

    from pugeo_service.cli import serve

    typer.run(serve)
