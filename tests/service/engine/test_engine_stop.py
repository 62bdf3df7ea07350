# SPDX-License-Identifier: Apache-2.0
"""An engine that is stopped before it has started."""

import asyncio
import contextlib
import signal
from pathlib import Path

import pytest
from tests.service.engine.standard import STANDARD

from pugeo_model import kernel_cache
from pugeo_service.engine import Engine, EngineStartError
from pugeo_service.settings import Settings


def test_a_stop_ends_the_compilation_of_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process that compiles kernels is ended, and not waited for."""
    monkeypatch.setattr(kernel_cache, "compiled", lambda: False)
    monkeypatch.setattr(kernel_cache, "_COMPILE", "import time; time.sleep(600)")

    async def scenario() -> None:
        engine = Engine(Settings(spool_dir=tmp_path), STANDARD)
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


def test_workers_that_never_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The start is given up after its time, with the setting and a likely cause."""

    async def never(_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr("pugeo_service.engine.dask_backend.DaskBackend.start", never)
    monkeypatch.setattr("pugeo_service.engine.engine.compile_kernels", lambda *_: None)

    async def scenario() -> None:
        engine = Engine(Settings(spool_dir=tmp_path, start_s=0.05), STANDARD)
        with pytest.raises(EngineStartError, match=r"within 0.05 s \(PUGEO_START_S\)"):
            await engine.start()
        assert engine.status.workers == 0
        await engine.stop()

    asyncio.run(scenario())
