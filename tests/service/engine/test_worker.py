# SPDX-License-Identifier: Apache-2.0
"""A stage runs, or its process ends in time."""

import subprocess
import sys

from pugeo_service.engine.worker import run_stage

_IMPORTS = "import threading, time; from pugeo_service.engine import backend, worker; "
_NO_GRACE = _IMPORTS + "worker._GRACE_S = 0; "


def run(code: str) -> "subprocess.CompletedProcess[str]":
    """Run code in a process that must end by itself."""
    command = [sys.executable, "-c", _NO_GRACE + code]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)


def test_a_stage_runs() -> None:
    """Arguments in, value out."""
    assert run_stage(lambda left, right: left - right, 10.0, 5, 3) == 2


def test_a_stage_that_hangs() -> None:
    """The process ends with a traceback that shows where it hung."""
    ended = run("worker.run_stage(time.sleep, 0.0, 600)")
    assert ended.returncode == 1
    assert "run_stage" in ended.stderr


def test_the_timer_stops_with_the_stage() -> None:
    """A process whose stage was in time lives on."""
    assert run("worker.run_stage(time.sleep, 0.0, 0.1); time.sleep(2)").returncode == 0


def test_a_quick_stage_leaves_the_timer_alone() -> None:
    """A quick stage that ends meanwhile does not stop the timer of one that hangs."""
    ended = run(
        "short = backend.quick(lambda: time.sleep(0.1)); "
        "threading.Timer(0.2, worker.run_stage, (short, 0.0)).start(); "
        "worker.run_stage(time.sleep, 0.0, 600)"
    )
    assert ended.returncode == 1
