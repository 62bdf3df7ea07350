# SPDX-License-Identifier: Apache-2.0
"""The bytes of an answer arrive whole and in order, whoever puts them where they belong."""

import asyncio
import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.service.engine.recorder import Handle, Recorder, run

from pugeo_service.engine.errors import DiskError, EngineLostError
from pugeo_service.storage.shared_file import SharedFile
from pugeo_service.storage.spool import Spool


def test_tiles_are_written_where_they_are(tmp_path: Path) -> None:
    """Where rows can follow each other nothing is joined: tiles agree, and each is written."""
    live: list[int] = []

    class Watched(Recorder):
        async def fetch(self, handle: Handle) -> Any:
            if handle.stage == "read_chunk":
                await asyncio.sleep(0.05)
                live.append(sum(each.live for each in self.of("densify")))
            return await super().fetch(handle)

    pool = Watched(9, tiles=5, by_rows=True)
    outcome, data = run(pool, tmp_path)
    # Of what is on its way no tile is kept, nor of those that both workers wrote meanwhile.
    assert live == [2, 2, 2, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    assert data == 5 * b"012"
    assert not pool.of("assemble")
    (agreed,) = pool.of("agree")
    assert [said.stage for said in agreed.args[1]] == ["border"] * 5
    written = pool.of("write_tile")
    assert [handle.args[0].args[0].args[0].args[1] for handle in written] == list(range(5))
    assert all(handle.args[1] is agreed for handle in written)
    assert outcome.report == {"points_in": 1}
    assert (outcome.seconds["finish"], outcome.seconds["write"]) == (7.0, 0.0)
    assert (outcome.seconds["project"], outcome.seconds["merge"]) == (2.5, 1.25)
    assert not any(handle.live for handle in pool.handles)


@pytest.mark.parametrize("by_rows", [False, True])
def test_workers_of_this_machine_write_the_answer(tmp_path: Path, by_rows: bool) -> None:
    """Into the file, behind what is there; now and then one cannot, and sends its bytes."""

    class Near(Recorder):
        def chunk(self, start: int, file: SharedFile, offset: int) -> bytes | int:
            data = np.frombuffer(str(start).encode(), np.uint8)
            return len(data) if offset % 2 and file.put(data, offset) else data.tobytes()

    pool = Near(9, seconds=lambda _: 0.001, tiles=5, by_rows=by_rows)
    outcome, data = run(pool, tmp_path)
    assert data == (5 if by_rows else 1) * b"012"
    assert outcome.spool.size == len(data)


@pytest.mark.parametrize("again", [b"", b"longer than it was"])
def test_a_part_that_changed(tmp_path: Path, again: bytes) -> None:
    """It was lost with its worker; another, of another kind, wrote other numbers."""

    class Changed(Recorder):
        def chunk(self, start: int, _file: SharedFile, _offset: int) -> bytes | int:
            return again if start else b""

    pool = Changed(3)
    with pytest.raises(EngineLostError, match="changed"):
        run(pool, tmp_path)
    assert not any(handle.live for handle in pool.handles)


def test_a_full_disk_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No room for the answer, however small its last piece, shows before the answer begins."""

    def store(_spool: Spool, _data: bytearray) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(Spool, "_store", store)
    pool = Recorder(3)
    with pytest.raises(DiskError) as caught:
        run(pool, tmp_path)
    assert caught.value.error.errno == errno.ENOSPC
    assert not any(handle.live for handle in pool.handles)
