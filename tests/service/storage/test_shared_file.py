# SPDX-License-Identifier: Apache-2.0
"""Another process writes into a file without a name, and into no other."""

import asyncio
import errno
import io
import os
import subprocess
import sys
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pugeo_service.storage.shared_file import NOWHERE, SharedFile, shared_file
from pugeo_service.storage.spool import Spool

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")

DATA = np.arange(256, dtype=np.uint8).repeat(20_000)


def test_another_process_writes(tmp_path: Path) -> None:
    """Behind what is there, whoever wrote that; the bytes come out in order."""
    script = (
        "import sys, numpy as np; from pugeo_service.storage.shared_file import SharedFile;"
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


def test_no_other_file_is_touched(tmp_path: Path) -> None:
    """The number of a file that was closed is soon that of the next one."""
    first, shared = shared_file(tmp_path)
    with first:
        number = first.fileno()
        assert shared.put(DATA, 0)
    with tempfile.TemporaryFile() as other:
        assert other.fileno() == number
        for content in (b"", b"short", b"another file, and one that is longer than a token"):
            os.pwrite(number, content, 0)
            assert not shared.put(DATA, 0)
            assert os.pread(number, 100, 0) == content
    assert not shared.put(DATA, 0)


def test_whoever_gives_up_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A request that is cancelled while its file is made closes that one."""
    share, cancelled, spools = Spool._share, threading.Event(), []

    def slow(spool: Spool) -> SharedFile:
        cancelled.wait(10)
        return share(spool)

    async def given_up() -> None:
        with Spool(tmp_path) as spool:
            spools.append(spool)
            task = asyncio.create_task(spool.share())
            await asyncio.sleep(0.05)
            task.cancel()
            asyncio.get_running_loop().call_later(0.1, cancelled.set)
            with pytest.raises(asyncio.CancelledError):
                await task

    monkeypatch.setattr(Spool, "_share", slow)
    asyncio.run(given_up())
    assert spools[0]._start > 0
    assert spools[0]._file.closed


def test_bytes_beyond_the_end_are_not_read(tmp_path: Path) -> None:
    """A worker that put more than the one after it, and died, leaves them there."""

    async def through() -> tuple[bytes, bytes]:
        with Spool(tmp_path) as spool:
            file = await spool.share()
            assert file.put(DATA, 0)
            await spool.take(100_000)
            pieces = b"".join([piece async for piece in spool.chunks(30_000)])
            return (await spool.read()).tobytes(), pieces

    assert asyncio.run(through()) == (DATA[:100_000].tobytes(), DATA[:100_000].tobytes())


class Full(io.BytesIO):
    """A file that takes bytes into its buffer, and finds no room for them."""

    def flush(self) -> None:
        """Fail, as every attempt will."""
        raise OSError(errno.ENOSPC, "No space left on device")

    def close(self) -> None:
        """Fail in another way."""
        raise OSError(errno.EIO, "Input/output error")


def test_a_full_disk_shows_at_once(tmp_path: Path) -> None:
    """Also for bytes so few that they fit the buffer of a file; and closing hides nothing."""

    async def filled() -> None:
        with Spool(tmp_path) as spool:
            await spool.share()
            spool._file.close()
            spool._file = Full()
            await spool.take(b"few")
            await spool.flush()

    with pytest.raises(OSError, match="No space"):
        asyncio.run(filled())


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


def test_a_disk_that_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is no error here: the front will find out for itself."""

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    file, shared = shared_file(tmp_path)
    with file:
        monkeypatch.setattr(os, "pwrite", full)
        assert not shared.put(DATA, 0)


def test_a_small_answer_needs_no_disk(tmp_path: Path) -> None:
    """A folder that takes no file makes one of a MiB no worse; larger ones are refused."""

    async def kept(size: int) -> bytes:
        with Spool(tmp_path / "missing") as spool:
            shared = await spool.share()
            assert shared is NOWHERE
            assert not shared.put(DATA, 0)
            await spool.take(bytes(size))
            return (await spool.read()).tobytes()

    assert asyncio.run(kept(1000)) == bytes(1000)
    with pytest.raises(FileNotFoundError):
        asyncio.run(kept(3 << 20))


def test_a_disk_that_takes_a_little_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a write leaves over is written next."""
    write = os.pwrite
    file, shared = shared_file(tmp_path)
    with file:
        monkeypatch.setattr(os, "pwrite", lambda number, data, at: write(number, data[:100], at))
        assert shared.put(DATA[:1234], 7)
        assert os.pread(file.fileno(), 1234, shared.start + 7) == DATA[:1234].tobytes()
