# SPDX-License-Identifier: Apache-2.0
"""A stage runs, or its process ends in time."""

import subprocess
import sys
import time

import pytest

from pugeo_service.engine import stages
from pugeo_service.engine.task import run_stage


def test_a_stage_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments in, value out."""
    monkeypatch.setattr(stages, "chunk", lambda left, right: left - right)
    assert run_stage("chunk", 10.0, 5, 3) == 2


def test_a_stage_that_hangs() -> None:
    """The process ends with a traceback that shows where it hung."""
    code = (
        "import time; from pugeo_service.engine import stages, task; task._GRACE_S = 0; "
        "stages.finish = time.sleep; task.run_stage('finish', 0.0, 60)"
    )
    start = time.monotonic()
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 1
    assert "run_stage" in ended.stderr
    assert time.monotonic() - start < 30


def test_the_clock_stops_with_the_stage() -> None:
    """A process whose stage was in time lives on."""
    code = (
        "import time; from pugeo_service.engine import stages, task; task._GRACE_S = 0; "
        "stages.finish = time.sleep; task.run_stage('finish', 0.0, 0.1); time.sleep(2)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_runs_beside_leaves_the_clock_alone() -> None:
    """A quick stage that ends meanwhile does not stop the clock of one that hangs."""
    code = (
        "import threading, time; from pugeo_service.engine import stages, task; task._GRACE_S = 0; "
        "stages.finish, stages.chunk = time.sleep, time.sleep; "
        "beside = threading.Timer(0.2, task.run_stage, ('chunk', 0.0, 0.1)); beside.start(); "
        "task.run_stage('finish', 0.0, 60)"
    )
    start = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert ended.returncode == 1
    assert time.monotonic() - start < 30
