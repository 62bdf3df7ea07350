# SPDX-License-Identifier: Apache-2.0
"""Another process writes into a file without a name, and into no other."""

import asyncio
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pugeo_service.shared_file import SharedFile
from pugeo_service.spool import Spool

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")

DATA = np.arange(256, dtype=np.uint8).repeat(20_000)


def test_another_process_writes(tmp_path: Path) -> None:
    """Behind what is there, whoever wrote that; the bytes come out in order."""
    script = (
        "import sys, numpy as np; from pugeo_service.shared_file import SharedFile;"
        "file = SharedFile(sys.argv[1], bytes.fromhex(sys.argv[2]));"
        "sys.exit(not file.put(np.arange(256, dtype=np.uint8).repeat(20_000), int(sys.argv[3])))"
    )

    async def through() -> tuple[bytes, bytes]:
        with Spool(tmp_path) as spool:
            file = await spool.share()
            assert await spool.take(b"before") == 6
            command = [sys.executable, "-c", script, file.path, file.token.hex(), str(spool.size)]
            await asyncio.to_thread(subprocess.run, command, check=True)
            assert await spool.take(DATA.size) == DATA.size
            await spool.take(b"behind")
            assert spool.size == 12 + DATA.size
            pieces = b"".join([piece async for piece in spool.chunks(100_000)])
            return (await spool.read()).tobytes(), pieces

    expected = b"before" + DATA.tobytes() + b"behind"
    assert asyncio.run(through()) == (expected, expected)
    assert list(tmp_path.iterdir()) == []


def test_no_other_file_is_touched() -> None:
    """The number of a file that was closed is soon that of the next one."""
    with tempfile.TemporaryFile() as first:
        shared = SharedFile.of(first.fileno())
        number = first.fileno()
        assert shared.put(DATA, 0)
    with tempfile.TemporaryFile() as other:
        assert other.fileno() == number
        for content in (b"", b"short", b"another file, and one that is longer than a token"):
            os.pwrite(number, content, 0)
            assert not shared.put(DATA, 0)
            assert os.pread(number, 100, 0) == content
    assert not shared.put(DATA, 0)


def test_what_is_no_such_file(tmp_path: Path) -> None:
    """A folder, a pipe that nobody reads, nothing at all, and one that may only be read."""
    shared = SharedFile(str(tmp_path), bytes(16))
    os.mkfifo(tmp_path / "pipe")
    read_only = tmp_path / "read-only"
    read_only.write_bytes(bytes(16))
    with read_only.open("rb") as file:
        read_only.chmod(0o400)
        for path in (tmp_path, tmp_path / "pipe", tmp_path / "nothing"):
            assert not replace(shared, path=str(path)).put(DATA, 0)
        if os.geteuid():  # nobody keeps root from writing
            assert not replace(shared, path=f"/proc/{os.getpid()}/fd/{file.fileno()}").put(DATA, 0)


def test_a_disk_that_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is no error here: the front will find out for itself."""

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with tempfile.TemporaryFile() as file:
        shared = SharedFile.of(file.fileno())
        monkeypatch.setattr(os, "pwrite", full)
        assert not shared.put(DATA, 0)


def test_a_disk_that_takes_a_little_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a write leaves over is written next."""
    write = os.pwrite
    with tempfile.TemporaryFile() as file:
        shared = SharedFile.of(file.fileno())
        monkeypatch.setattr(os, "pwrite", lambda number, data, at: write(number, data[:100], at))
        assert shared.put(DATA[:1234], 7)
        assert os.pread(file.fileno(), 1234, shared.start + 7) == DATA[:1234].tobytes()
