# SPDX-License-Identifier: Apache-2.0
"""Garbage collection of a ready front: objects that it loaded before are not searched again."""

import subprocess
import sys

_SCRIPT = """
import gc, sys
from pugeo_service import app, server
from tests.service.jobs.conftest import FakeEngine

class LookingEngine(FakeEngine):
    async def start(self):
        print("before", gc.get_freeze_count(), flush=True)

    async def stop(self):
        print("after", gc.get_freeze_count(), len(gc.get_objects()), flush=True)

app.Engine = LookingEngine
sys.exit(server.main(dict(port=0, drain_delay_s=0, drain_s=1, log_format="json")))
"""


def test_full_collections_of_a_ready_front_search_only_what_came_since() -> None:
    """Else each of them stops all answers for as long as a search of all loaded modules takes."""
    command = [sys.executable, "-c", _SCRIPT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as front:
        assert front.stdout is not None
        lines = []
        for line in front.stdout:
            lines.append(line.split())
            if line.startswith("ready:"):
                front.terminate()
    told = {name: rest for name, *rest in lines}
    assert told["before"] == ["0"]
    frozen, searched = map(int, told["after"])
    assert frozen > 5 * searched
