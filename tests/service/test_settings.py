# SPDX-License-Identifier: Apache-2.0
"""Settings come from the environment or the command line, and wrong ones are refused."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from pugeo_service import settings as module
from pugeo_service.settings import Settings


def test_the_environment_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """``PUGEO_`` and the name of a field sets it."""
    monkeypatch.setenv("PUGEO_PORT", "0")
    monkeypatch.setenv("PUGEO_WORKERS", "3")
    settings = Settings()
    assert (settings.port, settings.worker_count) == (0, 3)


def test_arguments_win(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments have priority over the environment."""
    monkeypatch.setenv("PUGEO_PORT", "1234")
    assert Settings(port=4321).port == 4321


def test_two_workers_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """On one processor there are two workers."""
    monkeypatch.setattr(module, "available_cpus", lambda: 1)
    assert Settings(workers=0).worker_count == 2


def test_one_worker_if_asked_for() -> None:
    """An explicit number of workers is used."""
    assert Settings(workers=1).worker_count == 1


@pytest.mark.parametrize("address", ["tcp://scheduler:8786", "scheduler:8786", "ws://x:1"])
def test_an_open_scheduler_is_refused(address: str) -> None:
    """A scheduler without TLS is refused, because it executes any code it receives."""
    with pytest.raises(ValidationError, match="tls://"):
        Settings(scheduler=address)


def test_a_scheduler_needs_credentials(tmp_path: Path) -> None:
    """The error names every missing file."""
    with pytest.raises(ValidationError, match="tls_cert, tls_key"):
        Settings(scheduler="tls://scheduler:8786", tls_ca=tmp_path / "ca.pem")


def test_a_spool_folder_must_exist(tmp_path: Path) -> None:
    """A missing folder is an error at the start."""
    with pytest.raises(ValidationError, match="not a folder"):
        Settings(spool_dir=tmp_path / "missing")
