# SPDX-License-Identifier: Apache-2.0
"""Pages of the documentation, and a real service that their snippets call."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pugeo_client import Client
from pugeo_client.errors import ConnectionFailedError

READY_S = 200.0
Serve = Callable[..., str]


@contextmanager
def _serving(log: Path, *options: str, folder: Path) -> Iterator[str]:
    """Run a service on a free port.

    Yields:
        Its address, once it is ready.
    """
    command = [sys.executable, "-m", "pugeo_service", "--port", "0", *options]
    environment = {**os.environ, "PUGEO_WORKERS": "1", "PUGEO_LOG_FORMAT": "json"}
    with (
        log.open("w") as stderr,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stderr, text=True, cwd=folder, env=environment
        ) as process,
    ):
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[-1:]
            assert address, log.read_text()[-4000:]
            end = time.monotonic() + READY_S
            with Client(address[0]) as client:
                while not _ready(client):
                    assert process.poll() is None, log.read_text()[-4000:]
                    assert time.monotonic() < end, log.read_text()[-4000:]
                    time.sleep(0.1)
            yield address[0]
        finally:
            process.terminate()
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
                raise


def _ready(client: Client) -> bool:
    try:
        return bool(client.health()["status"] == "ready")
    except ConnectionFailedError:
        return False


@pytest.fixture(scope="session")
def service(_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service that all pages share: one worker, no keys."""
    folder = tmp_path_factory.mktemp("service")
    with _serving(folder / "log", folder=folder) as address:
        yield address


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Starts a service of a page's own with options of ``pugeo serve``; ends it after the test."""
    running = []

    def start(*options: str, folder: Path) -> str:
        context = _serving(tmp_path / "log", "--engine", "inline", *options, folder=folder)
        running.append(context)
        return context.__enter__()

    yield start
    for context in running:
        context.__exit__(None, None, None)
