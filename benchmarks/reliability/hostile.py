# SPDX-License-Identifier: Apache-2.0
"""Attacks on an open port: one coroutine for each kind.

Each sends its part and returns the statuses that came back, ``()`` where the service hung up. With
a status of 500 or above comes the code of its problem, such as ``503 too_many_connections``.
"""

import asyncio
import contextlib
import random
import re
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

__all__ = ["HOLDING", "QUICK", "Address", "statuses"]

Address = tuple[str, int]
Mischief = Callable[[Address, random.Random], Awaitable[tuple[str, ...]]]

_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3}) ")
_CODE = re.compile(rb'"code": ?"(\w+)"')
_PATIENCE_S = 60.0
_BORED_S = 3.0
# Between two pieces of what never ends: who attacks shares the processor with who is attacked.
_PAUSE_S = 0.005
_POST = b"POST /upsample HTTP/1.1\r\nHost: x\r\n"
_GET = b"GET /health/live HTTP/1.1\r\nHost: x\r\n"
_WHOLE = _GET + b"\r\n"


@asynccontextmanager
async def _connected(
    address: Address,
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection(*address)
    try:
        yield reader, writer
    finally:
        # Reset and not finished in good order, as by whoever pulls the plug.
        tcp: socket.socket = writer.get_extra_info("socket")
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def statuses(reader: asyncio.StreamReader, seconds: float = _PATIENCE_S) -> tuple[str, ...]:
    """Read until the other end hangs up or time is over; return the statuses that were in there."""
    found = b""
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(seconds):
            while data := await reader.read(1 << 16):
                found += data
    # The text before the first status, then each status and the text that follows it.
    _, *parts = _STATUS.split(found)
    return tuple(
        _named(status.decode(), text) for status, text in zip(parts[::2], parts[1::2], strict=True)
    )


def _named(status: str, answer: bytes) -> str:
    code = _CODE.search(answer) if status.startswith("5") else None
    return f"{status} {code[1].decode()}" if code else status


async def _said(address: Address, data: bytes, seconds: float = 2.0) -> tuple[str, ...]:
    async with _connected(address) as (reader, writer):
        with contextlib.suppress(OSError):
            writer.write(data)
            await writer.drain()
        return await statuses(reader, seconds)


async def leave_at_once(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Connect and reset, perhaps after a few bytes."""
    async with _connected(address) as (_, writer):
        writer.write(_POST[: rng.randrange(len(_POST))])
    return ()


async def leave_amid_body(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Announce a body and pull the plug in the middle of it."""
    size = rng.choice((1000, 100_000, 3_000_000))
    async with _connected(address) as (_, writer):
        writer.write(_POST + b"Content-Length: %d\r\n\r\n" % size)
        writer.write(b"ply\n" + bytes(rng.randrange(size)))
        with contextlib.suppress(OSError):
            await writer.drain()
    return ()


async def endless_chunks(address: Address, rng: random.Random) -> tuple[str, ...]:
    """A chunked body that goes on until somebody minds."""
    size = rng.choice((4096, 65_536))
    chunk = b"%x\r\n" % size + bytes(size) + b"\r\n"
    # Most have had enough some seconds after they were told; some never have.
    bored = rng.choice((_BORED_S, _BORED_S, _BORED_S, _PATIENCE_S))
    async with _connected(address) as (reader, writer):
        writer.write(_POST + b"Transfer-Encoding: chunked\r\n\r\n")
        answer = asyncio.create_task(statuses(reader, bored))
        with contextlib.suppress(OSError):
            for _ in range(1 << 20):
                writer.write(chunk)
                await writer.drain()
                await asyncio.sleep(_PAUSE_S)
                if answer.done():
                    break
        return await answer


async def endless_head(address: Address, rng: random.Random) -> tuple[str, ...]:
    """A head without an end: one line, many lines, a path, a trailer or a chunk extension."""
    begin, more = rng.choice(
        (
            (_GET + b"X: ", b"a" * 65_536),
            (_GET, b"".join(b"X-%d: %s\r\n" % (i, b"v" * 50) for i in range(1000))),
            (b"GET /", b"a" * 65_536),
            (_POST + b"Transfer-Encoding: chunked\r\n\r\n1;x=", b"a" * 65_536),
            (_POST + b"Transfer-Encoding: chunked\r\n\r\n0\r\n", b"T: v\r\n" * 10_000),
        )
    )
    async with _connected(address) as (reader, writer):
        writer.write(begin)
        answer = asyncio.create_task(statuses(reader))
        with contextlib.suppress(OSError):
            for _ in range(600):
                writer.write(more)
                await writer.drain()
                await asyncio.sleep(_PAUSE_S)
                if answer.done() or writer.is_closing():
                    break
        return await answer


async def pipeline(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Many requests in one breath, some of them broken."""
    parts = [_WHOLE] * rng.choice((3, 50, 2000))
    if rng.random() < 0.5:
        parts.insert(rng.randrange(len(parts)), bytes(rng.randrange(256) for _ in range(40)))
    return await _said(address, b"".join(parts))


async def garbage(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Send bytes that are not HTTP/1.1, or unusual HTTP/1.1."""
    body = b"ply\n"
    return await _said(
        address,
        rng.choice(
            (
                rng.randbytes(rng.randrange(1, 5000)),
                b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + rng.randbytes(200),
                b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(9),
                b"GET /health/live HTTP/9.9\r\nHost: x\r\n\r\n",
                b"GET http://elsewhere/health/live HTTP/1.1\r\nHost: x\r\n\r\n",
                b"GET /\xff\xfe HTTP/1.1\r\nHost: x\r\n\r\n",
                b"GET /%00%ff%2e%2e/ HTTP/1.1\r\nHost: x\r\n\r\n",
                b"OPTIONS * HTTP/1.1\r\nHost: x\r\n\r\n",
                b"CONNECT elsewhere:443 HTTP/1.1\r\nHost: x\r\n\r\n",
                b"G\x00T / HTTP/1.1\r\nHost: x\r\n\r\n",
                _GET + b"X: a\x00b\r\n\r\n",
                _GET + b"X: " + bytes(range(128, 256)) + b"\r\n\r\n",
                _GET + b": no name\r\n\r\n",
                _GET + b" folded: yes\r\n\r\n",
                _GET.replace(b"\r\n", b"\n") + b"\n",
                _GET + b"Connection: Upgrade\r\nUpgrade: h2c\r\nHTTP2-Settings: AAMAAABk\r\n\r\n",
                _GET + b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
                _GET + b"Expect: 100-continue\r\nContent-Length: 5\r\n\r\n",
                _POST + b"Content-Length: -1\r\n\r\n" + body,
                _POST + b"Content-Length: 99999999999999999999999\r\n\r\n" + body,
                _POST + b"Content-Length: 4\r\nContent-Length: 5\r\n\r\n" + body,
                _POST + b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
                _POST + b"Transfer-Encoding: gzip, chunked\r\n\r\n0\r\n\r\n",
                _POST + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFFFFFFF\r\n" + body,
                _POST + b"Transfer-Encoding: chunked\r\n\r\n-4\r\nply\n\r\n0\r\n\r\n",
                _POST + b"Transfer-Encoding: chunked\r\n\r\n0\r\nX: y\r\n\r\n",
                _POST + b"Content-Type: multipart/form-data\r\nContent-Length: 4\r\n\r\n" + body,
                _POST + b"Content-Type: multipart/form-data; boundary=" + b"b" * 5000
                + b"\r\nContent-Length: 4\r\n\r\n" + body,
                _POST + b"Content-Encoding: gzip\r\nContent-Length: 4\r\n\r\n" + body,
                _POST + b"X-Request-ID: ../../etc\r\nContent-Length: 4\r\n\r\n" + body,
                _POST.replace(b" H", b"?R=" + b"9" * 5000 + b" H") + b"Content-Length: 0\r\n\r\n",
            )
        ),
    )  # fmt: skip


async def slow_head(address: Address, rng: random.Random) -> tuple[str, ...]:
    """A byte of the head now and then, so that the connection never seems idle (slow loris)."""
    return await _drip(address, b"", _GET + b"X: " + b"a" * 10_000, rng)


async def half_open(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Connect and say nothing."""
    return await _drip(address, b"", b"", rng)


async def slow_second_head(address: Address, rng: random.Random) -> tuple[str, ...]:
    """As `slow_head`, after a request that was in order."""
    return await _drip(address, _WHOLE, _GET + b"X: " + b"a" * 10_000, rng)


async def silent_body(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Announce a body and send nothing of it."""
    return await _drip(address, _POST + b"Content-Length: 100000\r\n\r\n", b"", rng)


async def deaf(address: Address, rng: random.Random) -> tuple[str, ...]:
    """Ask for a lot and never read it."""
    tcp = socket.socket()
    tcp.setblocking(False)
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    loop = asyncio.get_running_loop()
    try:
        await loop.sock_connect(tcp, address)
        ask = b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n" * 200
        with contextlib.suppress(OSError):
            await loop.sock_sendall(tcp, ask)
            while True:
                # A connection that was reset says so when it is written to.
                await asyncio.sleep(1 + rng.random())
                await loop.sock_sendall(tcp, b"G")
    finally:
        tcp.close()
    return ()


async def _drip(address: Address, first: bytes, rest: bytes, rng: random.Random) -> tuple[str, ...]:
    """Hold a connection until the service ends it, or for ever."""
    async with _connected(address) as (reader, writer):
        writer.write(first)
        answer = asyncio.create_task(statuses(reader, seconds=1e9))
        try:
            for byte in rest:
                writer.write(bytes([byte]))
                done, _ = await asyncio.wait({answer}, timeout=1 + rng.random())
                if done:
                    break
            return await answer
        finally:
            answer.cancel()


QUICK: tuple[Mischief, ...] = (
    leave_at_once,
    leave_amid_body,
    endless_chunks,
    endless_head,
    pipeline,
    garbage,
    garbage,
    garbage,
)
HOLDING: tuple[Mischief, ...] = (slow_head, half_open, slow_second_head, silent_body, deaf)
