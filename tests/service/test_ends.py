# SPDX-License-Identifier: Apache-2.0
"""A process whose end hangs is ended, with its workers, within its time."""

import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

# Each script prints the number of its worker process once it can be ended.
_BEGIN = """
import asyncio, multiprocessing, sys, time

def start_worker():
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    worker.start()
    print("worker", worker.pid, flush=True)
"""
_SERVER = """
from pugeo_service import app, server
from tests.service.jobs.conftest import FakeEngine

class HangingEngine(FakeEngine):
    async def start(self):
        start_worker()
        {stop_worker}

    async def stop(self):
        await asyncio.Event().wait()

app.Engine = HangingEngine
server._END_S = 0.5
sys.exit(server.main(dict(port=0, drain_delay_s=0, drain_s=1, log_format="json")))
"""
_CLUSTER = """
from pugeo_service import cluster
from pugeo_service.observability import logs

async def run(stop):
    start_worker()
    {stop_worker}
    await stop.wait()
    await asyncio.Event().wait()

logs.configure("json", "info")
cluster._END_S = 0.5
sys.exit(cluster._until_signal(run))
"""
_STOPPED = "import os, psutil, signal; os.kill(psutil.Process().children()[-1].pid, signal.SIGSTOP)"


def _runs(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("stop_worker", ["pass", _STOPPED], ids=["runs", "stopped"])
@pytest.mark.parametrize("script", [_SERVER, _CLUSTER], ids=["server", "cluster"])
def test_an_end_that_hangs(tmp_path: Path, root: Path, script: str, stop_worker: str) -> None:
    """Status 1 and a line in the log; no worker is left, not even a stopped one."""
    code = _BEGIN + script.format(stop_worker=stop_worker)
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=root,
        env={"PUGEO_SPOOL_DIR": str(tmp_path), "PATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        lines = iter(process.stdout.readline, "")
        worker = next((int(each.split()[1]) for each in lines if each.startswith("worker")), 0)
        assert worker, process.stderr and process.stderr.read()
        # Of the service once more, when it has started.
        if script is _SERVER:
            assert any(line.startswith("ready") for line in lines)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=100)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 1
    (line,) = [line for line in errors.splitlines() if "did not end in time" in line]
    assert '"workers": 1' in line
    psutil.wait_procs([psutil.Process(worker)] if psutil.pid_exists(worker) else [], 10)
    assert not _runs(worker)
