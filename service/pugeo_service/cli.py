# SPDX-License-Identifier: Apache-2.0
"""``pugeo serve``, ``pugeo scheduler``, ``pugeo worker`` and ``pugeo keys``."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

__all__ = ["keys", "scheduler", "serve", "worker"]

Option = typer.Option


@contextmanager
def _needs_extra(command: str) -> Iterator[None]:
    """Say which extra to install if a package is missing."""
    try:
        yield
    except ModuleNotFoundError as missing:
        typer.echo(f"{command} needs {missing.name}: pip install 'pugeo[server]'", err=True)
        raise typer.Exit(2) from None


def serve(
    host: Annotated[str | None, Option(help="Address to listen on [127.0.0.1].")] = None,
    port: Annotated[int | None, Option(help="Port; 0 takes a free one [8000].")] = None,
    workers: Annotated[
        int | None, Option(help="Worker processes; 0: one per processor, at least two [0].")
    ] = None,
    engine: Annotated[
        str | None, Option(help="dask, or inline: threads in this process, for debugging [dask].")
    ] = None,
    scheduler: Annotated[
        str | None, Option(help="tls://host:port of an external Dask cluster.")
    ] = None,
    model: Annotated[
        str | None, Option(help="Default model, or path of its weights [standard].")
    ] = None,
    models_dir: Annotated[Path | None, Option(help="Folder of further models.")] = None,
    canary: Annotated[
        str | None, Option(help="NAME:SHARE of a model for some of the requests.")
    ] = None,
    max_body_bytes: Annotated[int | None, Option(help="Maximum bytes of a body.")] = None,
    max_points: Annotated[int | None, Option(help="Maximum points of an input.")] = None,
    max_output_points: Annotated[int | None, Option(help="Maximum points of an answer.")] = None,
    queue_patches: Annotated[int | None, Option(help="Capacity of the queue in patches.")] = None,
    queue_requests: Annotated[int | None, Option(help="Capacity of the queue in requests.")] = None,
    deadline_s: Annotated[float | None, Option(help="Maximum seconds of a request [600].")] = None,
    drain_s: Annotated[
        int | None, Option(help="Seconds after SIGTERM to finish accepted requests [60].")
    ] = None,
    spool_dir: Annotated[
        Path | None, Option(help="Folder for temporary files of bodies and answers.")
    ] = None,
    metrics_port: Annotated[int | None, Option(help="Separate port for metrics.")] = None,
    api_keys_file: Annotated[
        Path | None, Option(help="File of API keys, see `pugeo keys new` [no keys].")
    ] = None,
    cors_origins: Annotated[
        str | None, Option(help="Comma-separated origins whose pages may call the service.")
    ] = None,
    log_format: Annotated[str | None, Option(help="auto, json or console [auto].")] = None,
    log_level: Annotated[str | None, Option(help="debug, info, warning or error [info].")] = None,
) -> None:
    """Serve upsampling over HTTP.

    Every option can also be set in the environment: PUGEO_PORT=8080, PUGEO_WORKERS=4.
    """
    given: dict[str, Any] = {name: value for name, value in locals().items() if value is not None}
    # Imported here: the command line lists its commands without loading a web framework.
    with _needs_extra("serve"):
        from pugeo_service.server import main

    raise typer.Exit(main(given))


def scheduler(
    host: Annotated[str, Option(help="Address to listen on, also for other machines.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8786,
    log_format: Annotated[str | None, Option(help="auto, json or console [auto].")] = None,
    log_level: Annotated[str | None, Option(help="debug, info, warning or error [info].")] = None,
) -> None:
    """Schedule the work of fronts (pugeo serve --scheduler) on workers (pugeo worker).

    All connections are mutual TLS: PUGEO_TLS_CA, PUGEO_TLS_CERT and PUGEO_TLS_KEY name the files.
    """
    given: dict[str, Any] = {"log_format": log_format, "log_level": log_level}
    with _needs_extra("scheduler"):
        from pugeo_service.cluster import scheduler_main

    chosen = {name: value for name, value in given.items() if value is not None}
    address = f"tls://[{host}]:{port}" if ":" in host else f"tls://{host}:{port}"
    raise typer.Exit(scheduler_main({"scheduler": address, **chosen}))


def worker(
    scheduler: Annotated[
        str | None, Option(help="tls://host:port of a `pugeo scheduler` [PUGEO_SCHEDULER].")
    ] = None,
    workers: Annotated[
        int | None, Option(help="Worker processes; 0: one per processor, at least two [0].")
    ] = None,
    worker_memory: Annotated[
        str | None, Option(help="Memory limit of a worker: 2GB, or a share of all memory [auto].")
    ] = None,
    host: Annotated[
        str | None,
        Option(help="Address at which other machines reach these workers [that of the way out]."),
    ] = None,
    port: Annotated[
        int | None,
        Option(min=1, max=65000, help="First of two ports for each worker [free ones]."),
    ] = None,
    spool_dir: Annotated[Path | None, Option(help="Folder for temporary files.")] = None,
    log_format: Annotated[str | None, Option(help="auto, json or console [auto].")] = None,
    log_level: Annotated[str | None, Option(help="debug, info, warning or error [info].")] = None,
) -> None:
    """Work for a scheduler, on this machine, for fronts on others.

    Options can also be set in the environment, as for `pugeo serve`; PUGEO_TLS_CA, PUGEO_TLS_CERT
    and PUGEO_TLS_KEY name the certificates. A scheduler that goes away is waited for.
    """
    given = {name: value for name, value in locals().items() if value is not None}
    for name in ("host", "port"):
        given.pop(name, None)
    with _needs_extra("worker"):
        from pugeo_service.cluster import worker_main

    raise typer.Exit(worker_main(given, host, port))


def keys(
    action: Annotated[Literal["new"], typer.Argument(help="new: make a key.")],
    name: Annotated[str, typer.Argument(help="Owner of the key, in logs and for fair shares.")],
) -> None:
    """Make an API key: its entry goes to stdout, the key itself to stderr.

    Append the entry to the file that PUGEO_API_KEYS_FILE names: pugeo keys new NAME >> FILE. The
    service reads the file again when it changes. Remove the line to revoke the key.
    """
    del action  # there is only one
    with _needs_extra("keys"):
        from pugeo_service.keys import Entry, hash_of, new_token, parse

    token = new_token()
    entry = Entry(name, hash_of(token))
    try:
        parse([str(entry)])
    except ValueError:
        detail = "1 to 64 letters, digits, dots, dashes and underscores"
        raise typer.BadParameter(detail, param_hint="NAME") from None
    typer.echo(f"The key, which is shown only once: {token}", err=True)
    typer.echo(str(entry))
