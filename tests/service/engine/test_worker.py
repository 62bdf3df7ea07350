# SPDX-License-Identifier: Apache-2.0
"""A stage that exceeds its time limit ends its process."""

import faulthandler
import subprocess
import sys

import pytest

from pugeo_service.engine.backend import quick
from pugeo_service.engine.worker import run_stage


def test_a_stage_runs() -> None:
    """The stage gets its arguments, and its value is returned."""
    assert run_stage(lambda left, right: left - right, 10.0, 5, 3) == 2


def test_a_stage_that_hangs() -> None:
    """The process ends with a traceback of the place."""
    code = (
        "import time; from pugeo_service.engine import worker; worker._GRACE_S = 0; "
        "worker.run_stage(time.sleep, 0.0, 600)"
    )
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100)
    assert ended.returncode == 1
    assert "run_stage" in ended.stderr


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Calls of the timer, in order."""
    called: list[str] = []
    monkeypatch.setattr(
        faulthandler, "dump_traceback_later", lambda *_, **__: called.append("start")
    )
    monkeypatch.setattr(faulthandler, "cancel_dump_traceback_later", lambda: called.append("stop"))
    return called


def test_the_timer_stops_with_the_stage(calls: list[str]) -> None:
    """The timer starts before a stage and stops after it, also after an error."""
    run_stage(lambda: calls.append("stage"), 0.0)
    with pytest.raises(ZeroDivisionError):
        run_stage(lambda: 1 / 0, 0.0)
    assert calls == ["start", "stage", "stop", "start", "stop"]


def test_a_quick_stage_leaves_the_timer_alone(calls: list[str]) -> None:
    """A quick stage neither starts nor stops the timer of another stage."""
    run_stage(quick(lambda: calls.append("stage")), 0.0)
    assert calls == ["stage"]
