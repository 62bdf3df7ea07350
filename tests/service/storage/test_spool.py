# SPDX-License-Identifier: Apache-2.0
"""Bytes come out of a spool as they went in, and nothing stays behind."""

import asyncio
from pathlib import Path

import pytest

from pugeo_service.storage.spool import Spool


@pytest.mark.parametrize("size", [0, 10, 70_000, 1 << 20, (5 << 20) + 3])
def test_the_bytes_survive(tmp_path: Path, size: int) -> None:
    """In memory and on disk, whole and in chunks."""
    data = bytes(range(256)) * (size // 256 + 1)
    data = data[:size]

    async def through() -> tuple[bytes, bytes, int]:
        with Spool(tmp_path) as spool:
            for start in range(0, size, 65_536):
                await spool.write(data[start : start + 65_536])
            whole = (await spool.read()).tobytes()
            pieces = b"".join([piece async for piece in spool.chunks(100_000)])
            return whole, pieces, spool.size

    assert asyncio.run(through()) == (data, data, size)
    assert list(tmp_path.iterdir()) == []


def test_large_ones_leave_the_memory(tmp_path: Path) -> None:
    """More than a mebibyte is in a file of the spool folder."""

    async def rolled() -> bool:
        with Spool(tmp_path) as spool:
            await spool.write(bytes(3 << 20))
            return bool(spool._file._rolled)  # type: ignore[attr-defined]

    assert asyncio.run(rolled())
