# SPDX-License-Identifier: Apache-2.0
"""Keys, shares and deadlines on a real service."""

import io
import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.http_client import HTTP

from pugeo_client import Client, errors
from pugeo_model import Cloud, formats
from pugeo_service.keys import Entry, hash_of

pytestmark = pytest.mark.slow


def ball(count: int) -> bytes:
    """A sphere of so many points, as a PLY file."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


SMALL, LARGE = ball(1000), ball(20_000)


def bearer(name: str) -> dict[str, str]:
    """The header of a key; its token is its name twice."""
    return {"Authorization": f"Bearer {name * 2}"}


def write_keys(path: Path, *names: str) -> None:
    """Replace the file by one with the keys of these names, as mounted secrets are."""
    path.with_suffix(".new").write_text(
        "".join(f"{Entry(name, hash_of(name * 2))}\n" for name in names)
    )
    path.with_suffix(".new").replace(path)


def metrics_of(log: Path) -> str:
    """Metrics at their separate port, which the log contains."""
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        if entry["event"] == "metrics":
            return HTTP.get(f"http://127.0.0.1:{entry['port']}/metrics", timeout=60).text
    pytest.fail("the log has no port of metrics")


def test_keys_shares_and_deadlines(launch: Any, tmp_path: Path) -> None:
    """Shares of owners, rotation of keys, and refusal of deadlines that cannot be met."""
    path = tmp_path / "keys"
    write_keys(path, "ann")
    options = ["--engine", "inline", "--queue-patches", "15", "--metrics-port", "0"]
    options += ["--api-keys-file", str(path)]
    with launch(*options, SLOW_S="0.3") as server:
        server.wait_until_ready()
        url = f"{server.url}/upsample?R=2"
        assert HTTP.post(url, content=SMALL, timeout=60).status_code == 401
        assert (
            HTTP.get(f"{server.url}/metrics", headers=bearer("ann"), timeout=60).status_code == 404
        )
        assert 'pugeo_queue_patches{queue="requests"} 0.0' in metrics_of(server.log)

        # The large cloud of one owner takes more than half of the queue; another one is served.
        answers: dict[str, Any] = {}
        wait = {"Prefer": "wait=60", **bearer("ann")}

        def large() -> None:
            answers["large"] = HTTP.post(url, content=LARGE, headers=wait, timeout=100)

        thread = threading.Thread(target=large)
        thread.start()
        while 'pugeo_queue_patches{queue="requests"} 0.0' in metrics_of(server.log):
            time.sleep(0.02)
        write_keys(path, "ann", "bob")
        refused = HTTP.post(url, content=ball(8000), headers=bearer("ann"), timeout=60)
        assert (refused.status_code, refused.json()["code"]) == (429, "share_exceeded")
        assert refused.json()["retryable"] is True
        assert int(refused.headers["retry-after"]) >= 1
        with Client(server.url, api_key="bobbob", timeout=60) as bob:
            dense = bob.upsample(SMALL, 2)
            assert len(dense) == 2000
        assert "large" not in answers
        thread.join()
        assert answers["large"].status_code == 200
        assert answers["large"].headers["preference-applied"] == "wait=60"

        # The cost of a patch is measured now, so a deadline of one second is refused.
        late = HTTP.post(
            url, content=LARGE, headers={"Prefer": "wait=1", **bearer("ann")}, timeout=60
        )
        assert late.status_code == 504
        assert late.json()["code"] in {"deadline_too_short", "deadline_exceeded"}
        after = HTTP.post(url, content=SMALL, headers=bearer("ann"), timeout=60)
        assert after.status_code == 200
        assert 'pugeo_queue_patches{queue="requests"} 0.0' in metrics_of(server.log)

        # A removed key is refused without a restart, and every key once the file is deleted.
        write_keys(path, "ann")
        with Client(server.url, api_key="bobbob") as bob, pytest.raises(errors.UnauthorizedError):
            bob.upsample(SMALL)
        path.unlink()
        assert (
            HTTP.get(f"{server.url}/models", headers=bearer("ann"), timeout=60).status_code == 401
        )
        assert HTTP.get(f"{server.url}/health/live", timeout=60).status_code == 200
        assert server.stop() == 0
        log = server.log.read_text()
        assert '"owner": "bob"' in log
        assert "bobbob" not in log
        assert "annann" not in log


def test_a_metrics_port_that_is_taken(server: Any) -> None:
    """A metrics port in use is an error at the start."""
    taken = server.url.rpartition(":")[2]
    command = [sys.executable, "-m", "pugeo_service", "--port", "0", "--metrics-port", taken]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert "cannot listen" in ended.stderr
    assert "Traceback" not in ended.stderr
