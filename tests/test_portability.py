# SPDX-License-Identifier: Apache-2.0
"""The packages on systems without fcntl, users' numbers, /proc and writing at a place of a file.

Each test runs in a fresh interpreter in which these are taken away before anything is imported.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# As Windows has it. `os` stays posix, and `resource` stays: libraries of this system need them.
ABSENT = """
import os, sys, pathlib
import locket  # Dask's locks take those of Windows only where there is Windows
for module in ("fcntl", "pwd", "grp"):
    sys.modules[module] = None
names = ["geteuid", "getuid", "getegid", "getgid", "pread", "pwrite", "preadv", "pwritev",
         "sched_getaffinity", "O_CLOEXEC", "O_NONBLOCK", "fchmod", "fork", "posix_fallocate"]
for name in names:
    if hasattr(os, name):
        delattr(os, name)
def hidden(path):
    return not isinstance(path, int) and os.fspath(path).startswith(("/proc", "/sys"))
opened = os.open
def os_open(path, *args, **kwargs):
    if hidden(path):
        raise FileNotFoundError(2, "no such file", path)
    if os.path.isdir(path):
        raise PermissionError(13, "folders cannot be opened", path)
    return opened(path, *args, **kwargs)
os.open = os_open
"""


def run(code: str, root: Path, *arguments: str) -> str:
    """Run code in an interpreter without these names; returns what it prints."""
    paths = [str(root / home) for home in ("client", "model", "service")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-W", "error::ResourceWarning", "-c", ABSENT + code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_everything_is_imported(root: Path) -> None:
    """No module needs them when it is imported."""
    code = """
import importlib, pkgutil
import pugeo_client, pugeo_model, pugeo_service
count = 0
for package in (pugeo_client, pugeo_model, pugeo_service):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
            count += 1
print(count)
"""
    assert int(run(code, root)) > 200


@pytest.mark.slow
def test_the_command_line(root: Path, tmp_path: Path) -> None:
    """`pugeo upsample` reads, upsamples and writes a file."""
    code = """
import numpy as np
from pugeo_model import Cloud, read, write
from pugeo_model.cli import main
points = np.random.default_rng(0).normal(size=(200, 3))
folder = pathlib.Path(sys.argv[1])
write(Cloud(points / np.linalg.norm(points, axis=1, keepdims=True)), folder / "a.ply")
sys.argv = ["pugeo", "upsample", str(folder / "a.ply"), "-o", f"{folder}/dense/", "-R", "2"]
try:
    main()
except SystemExit as ended:
    assert not ended.code, ended.code
print(len(read(folder / "dense" / "a.ply")))
"""
    assert run(code, root, str(tmp_path)).split() == ["400"]


@pytest.mark.slow
def test_the_service_with_jobs(root: Path, tmp_path: Path) -> None:
    """A service answers a request and runs a job; its folder of jobs is locked and left tidy."""
    code = """
import time, numpy as np
from starlette.testclient import TestClient
from pugeo_service.app import create_app
from pugeo_service.settings import Settings
folder = pathlib.Path(sys.argv[1])
settings = Settings(engine="inline", spool_dir=folder, jobs_dir=folder / "jobs")
points = np.random.default_rng(0).normal(size=(200, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)
body = "\\n".join(f"{x} {y} {z}" for x, y, z in points)
with TestClient(create_app(settings)) as client:
    while client.get("/health/ready").status_code != 200:
        time.sleep(0.05)
    dense = client.post("/upsample?R=2", content=body)
    assert dense.status_code == 200, dense.text
    assert len(list((folder / "jobs" / "runners").iterdir())) == 1
    job = client.post("/jobs?R=2", content=body).json()
    while (state := client.get(f"/jobs/{job['id']}").json()["state"]) in ("queued", "running"):
        time.sleep(0.05)
    assert state == "succeeded", state
    assert client.get(f"/jobs/{job['id']}/result").content == dense.content
print(len(dense.text.splitlines()), list((folder / "jobs" / "runners").iterdir()))
"""
    last = run(code, root, str(tmp_path)).splitlines()[-1]
    # A line of names, and 400 points.
    assert last == "401 []"


def test_locks_of_processes(root: Path, tmp_path: Path) -> None:
    """Without locks of the kernel a process counts as running until it has ended."""
    code = """
import subprocess
from pathlib import Path
from pugeo_service.jobs.process_lock import ProcessLock
other = "from pathlib import Path; from pugeo_service.jobs.process_lock import ProcessLock; " \\
    "p = ProcessLock(Path(sys.argv[1])); p.acquire(); print(p.name, flush=True); sys.stdin.read()"
absent = Path(sys.argv[2]).read_text()
child = subprocess.Popen([sys.executable, "-c", absent + other, sys.argv[1]],
                         stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
name = child.stdout.readline().strip()
lock = ProcessLock(Path(sys.argv[1]))
lock.acquire()
lock.acquire()
alive = [lock.is_alive(name), lock.is_only_process]
child.kill()
child.wait()
child.stdin.close()
child.stdout.close()
print(alive, lock.ended([name, "never", lock.name]) == [name, "never"], lock.is_only_process)
lock.release()
lock.release()
print(list((Path(sys.argv[1]) / "runners").iterdir()))
"""
    (tmp_path / "absent.py").write_text(ABSENT)
    shown = run(code, root, str(tmp_path), str(tmp_path / "absent.py"))
    assert shown.splitlines() == ["[True, False] True True", "[]"]
