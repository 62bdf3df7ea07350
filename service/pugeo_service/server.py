# SPDX-License-Identifier: Apache-2.0
"""The server process: uvicorn that drains on SIGTERM, finishes admitted requests and exits 0."""

import asyncio
import contextlib
import gc
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

import structlog
import uvicorn

from pugeo_model.errors import BadOptionError
from pugeo_service.app import create_app, create_metrics_app
from pugeo_service.container import Service
from pugeo_service.engine.children import end_at_once
from pugeo_service.http.connection_limit import LINGERING, usable_descriptors
from pugeo_service.http.protocol import ServerProtocol
from pugeo_service.models import Models
from pugeo_service.preflight import unusable_host
from pugeo_service.settings import Settings
from pugeo_service.startup import begin, read_settings

__all__ = ["main", "serve"]

_log = structlog.stdlib.get_logger("pugeo.service")
# Of workers, the database, files of requests, and the system's own.
_OTHER_DESCRIPTORS = 128
_OF_A_REQUEST = 4
_METRICS_CONNECTIONS = 32
_METRICS_STOP_S = 5.0
# Seconds after the time to drain in which workers, jobs and files are closed in order.
_END_S = 120.0
_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service
        settings = service.settings
        self._delay_s = settings.drain_delay_s
        self._end_s = settings.drain_delay_s + settings.drain_s + _END_S
        self._stopping: threading.Timer | None = None
        self.failed = False

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        # uvicorn raises the signal again after a clean shutdown, which would end the process with
        # status 143 although it finished all admitted requests.
        before = {number: signal.signal(number, self.handle_exit) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, _frame: FrameType | None) -> None:
        if self._stopping is None:
            # Whatever hangs, the process ends.
            self._stopping = threading.Timer(self._end_s, end_at_once)
            self._stopping.daemon = True
            self._stopping.start()
        if self._service.admission.draining:
            self.should_exit = True
            self.force_exit = sig == signal.SIGINT
            return
        self._service.admission.draining = True
        loop = asyncio.get_event_loop()
        # Not here: a signal handler may interrupt code that uses the same state.
        loop.call_soon_threadsafe(self._service.drain)
        # Load balancers need some time to see "draining" before connections are refused.
        loop.call_soon_threadsafe(loop.call_later, self._delay_s, self._exit)

    def fail(self) -> None:
        self.failed = True
        self._exit()

    def _exit(self) -> None:
        self.should_exit = True


def main(given: dict[str, Any]) -> int:
    """Serve with these settings over those of the environment; return the exit status.

    Returns:
        0 after a clean end, 1 if the service could not start, 2 for a wrong setting.
    """
    settings = read_settings(given)
    return 2 if settings is None else serve(settings)


def serve(settings: Settings) -> int:
    """Serve until a signal ends it; return the exit status of the process.

    The address is printed on stdout at once, because port 0 selects a free port, and once more when
    requests are served.
    """
    problem = unusable_host(settings.host, "PUGEO_HOST") or _too_few_descriptors(settings)
    if problem is not None:
        sys.stderr.write(problem + "\n")
        return 2
    if not begin(settings):
        return 2
    try:
        models = Models(settings)
    except BadOptionError as error:
        sys.stderr.write(error.message + "\n")
        return 2
    server: _Server | None = None
    address = ""

    def on_ready() -> None:
        # What is loaded now stays for ever: without it in the way, each full collection of garbage
        # stops the event loop for a few milliseconds, and not for a tenth of a second.
        gc.collect()
        gc.freeze()
        sys.stdout.write(f"ready: {address}\n")
        sys.stdout.flush()

    def on_fatal() -> None:
        if server is not None:
            server.fail()

    app = create_app(settings, on_fatal, on_ready, models)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        http=ServerProtocol.limited(_connections(settings), "PUGEO_MAX_CONNECTIONS"),
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=settings.drain_s,
    )
    service: Service = app.state.service
    with contextlib.ExitStack() as opened:
        port = settings.port
        try:
            listener = opened.enter_context(_listen(settings.host, port))
            if settings.metrics_port is not None:
                port = settings.metrics_port
                opened.enter_context(_metrics(settings.host, port, service))
        except OSError as error:
            _log.error("cannot listen", host=settings.host, port=port, reason=str(error))
            return 1
        server = _Server(config, service)
        port = listener.getsockname()[1]
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        address = f"http://{host}:{port}"
        sys.stdout.write(f"pugeo serves {address}\n")
        sys.stdout.flush()
        # An interrupt that comes before uvicorn handles signals.
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listener])
    return 1 if server.failed else 0


def _connections(settings: Settings) -> int:
    """Return the bound on connections, which leaves descriptors for files and workers."""
    others = _other_descriptors(settings)
    return min(settings.max_connections, usable_descriptors(others + _wanted(settings)) - others)


def _too_few_descriptors(settings: Settings) -> str | None:
    """Return a line about a queue that is longer than the connections which this process may have.

    Without it a large queue would leave a few connections, so that it could never be full.
    """
    needed = _other_descriptors(settings) + _wanted(settings)
    usable = usable_descriptors(needed)
    if usable >= needed:
        return None
    queue, running = settings.queue_requests, settings.jobs_running
    return (
        f"PUGEO_QUEUE_REQUESTS={queue}, PUGEO_JOBS_RUNNING={running}: so many need {needed:,} open "
        f"files, and this process may have {usable:,} (ulimit -n); lower them, or allow more files"
    )


def _other_descriptors(settings: Settings) -> int:
    running = settings.queue_requests + settings.jobs_running
    return _OTHER_DESCRIPTORS + LINGERING + _OF_A_REQUEST * running


def _wanted(settings: Settings) -> int:
    """Return the connections that a full queue has."""
    return min(settings.queue_requests, settings.max_connections)


@contextlib.contextmanager
def _metrics(host: str, port: int, service: Service) -> Iterator[None]:
    """Serve metrics on a separate port, in a separate thread, with the limits of the service."""
    with _listen(host, port) as listener:
        config = uvicorn.Config(
            create_metrics_app(service),
            http=ServerProtocol.limited(_METRICS_CONNECTIONS, setting=None),
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        _log.info("metrics", port=listener.getsockname()[1])
        try:
            yield
        finally:
            server.should_exit = True
            thread.join(_METRICS_STOP_S)


def _listen(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    listener = socket.socket(family, kind, protocol)
    try:
        if os.name == "posix":
            # On Windows this would let another program take the port over.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        # Clients may connect as soon as the address is printed, before uvicorn starts.
        listener.listen()
    except OSError:
        listener.close()
        raise
    return listener
