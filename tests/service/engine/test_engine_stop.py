# SPDX-License-Identifier: Apache-2.0
"""An engine that is stopped before it has started."""

import asyncio
import contextlib
import signal
from pathlib import Path

import pytest

from pugeo_model import kernel_cache
from pugeo_service.engine import Engine
from pugeo_service.settings import Settings


def test_a_stop_ends_the_compilation_of_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process that compiles kernels is ended, and not waited for."""
    monkeypatch.setattr(kernel_cache, "compiled", lambda: False)
    monkeypatch.setattr(kernel_cache, "_COMPILE", "import time; time.sleep(600)")

    async def scenario() -> None:
        engine = Engine(Settings(spool_dir=tmp_path))
        starting = asyncio.create_task(engine.start())
        while engine._compiling is None:
            assert not starting.done()
            await asyncio.sleep(0.01)
        starting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await starting
        await engine.stop()
        assert engine._compiling.wait(60) == -signal.SIGKILL

    asyncio.run(scenario())
