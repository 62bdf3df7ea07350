# SPDX-License-Identifier: Apache-2.0
"""Both clients against a server that lies: every call ends with an error of the package."""

import gzip
import io
import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from pugeo_client.errors import InvalidResponseError, PugeoError, ServerError, StatusError

ClientRunner = Callable[..., Any]
HTML = b"<!DOCTYPE html><html>Please log in</html>"


class Streamed(httpx2.SyncByteStream, httpx2.AsyncByteStream):
    """Body of an answer that is not decoded before the client asks; counts what was taken."""

    def __init__(self, *chunks: bytes, repeat: int = 1) -> None:
        self._chunks = chunks
        self._repeat = repeat
        self.taken = 0

    def __iter__(self) -> Iterator[bytes]:
        for _ in range(self._repeat):
            for chunk in self._chunks:
                self.taken += len(chunk)
                yield chunk

    async def __aiter__(self) -> Any:
        for chunk in self:
            yield chunk


def job(**changes: Any) -> dict[str, Any]:
    record: dict[str, Any] = {
        "id": "abc",
        "state": "queued",
        "progress": {"stage": "queued", "done": 0, "total": None},
        "options": {"format": "ply"},
        "report": None,
        "problem": None,
    }
    return record | changes


@pytest.mark.parametrize(
    ("body", "headers"),
    [
        (HTML, {"Content-Type": "text/html"}),
        (HTML, {}),
        (b"", {}),
        (b"ply\nformat binary_little_endian 1.0\n", {}),
        (None, {"Pugeo-Points-Out": "4"}),
        (None, {"Pugeo-Points-Out": "2"}),
    ],
)
@pytest.mark.parametrize("name", ["d.ply", None])
def test_an_answer_that_is_not_the_cloud(
    run_client: ClientRunner,
    ply_bytes: bytes,
    tmp_path: Path,
    body: bytes | None,
    headers: dict[str, str],
    name: str | None,
) -> None:
    """A web page with status 200, or another number of points, replaces no file."""
    out = None if name is None else tmp_path / name
    if out is not None:
        out.write_bytes(b"older")
    content = ply_bytes if body is None else body

    def service(_: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(200, headers=headers, content=content)

    with pytest.raises(InvalidResponseError):
        run_client(lambda client: client.upsample(b"ply\n", out=out), service)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"] * (out is not None)


@pytest.mark.parametrize("call", ["upsample", "health", "models", "job"])
@pytest.mark.parametrize("status", [200, 500])
def test_compressed_answers_are_not_unpacked(
    run_client: ClientRunner, call: str, status: int
) -> None:
    """No request allows compression; a compressed answer is refused before it is unpacked."""
    bomb = gzip.compress(bytes(50_000_000))
    streams: list[Streamed] = []

    def service(request: httpx2.Request) -> httpx2.Response:
        assert request.headers["Accept-Encoding"] == "identity"
        streams.append(Streamed(bomb))
        return httpx2.Response(status, headers={"Content-Encoding": "gzip"}, stream=streams[-1])

    arguments: dict[str, list[Any]] = {"upsample": [b"ply\n"], "job": ["abc"]}
    argument = arguments.get(call, [])
    with pytest.raises(InvalidResponseError if status == 200 else ServerError):
        run_client(lambda client: getattr(client, call)(*argument), service)
    assert [stream.taken for stream in streams] == [0]


def test_damaged_compression(run_client: ClientRunner, serve: Any) -> None:
    """An answer that claims to be gzip and is not raises no DecodingError."""

    def script(connection: socket.socket, _: int) -> None:
        connection.recv(65536)
        connection.sendall(
            b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\nContent-Length: 5\r\n\r\nnoise"
        )

    with serve(script) as url, pytest.raises(InvalidResponseError, match="compressed"):
        run_client(lambda client: client.health(), base_url=url)


@pytest.mark.parametrize(("status", "error"), [(200, InvalidResponseError), (500, ServerError)])
def test_documents_without_an_end(
    run_client: ClientRunner, status: int, error: type[PugeoError]
) -> None:
    """A JSON answer, and an error page, are read to a limit."""
    stream = Streamed(b"[" * 65536, repeat=100_000)  # 6.5 GB

    with pytest.raises(error):
        run_client(lambda client: client.health(), lambda _: httpx2.Response(status, stream=stream))
    assert stream.taken < 20_000_000


@pytest.mark.parametrize(
    "pages",
    [
        [{"jobs": [job()], "next": "a"}],
        [{"jobs": [job()], "next": "a"}, {"jobs": [job()], "next": "b"}] * 2,
        [{"jobs": [], "next": "a"}],
        [{"jobs": [job()], "next": 5}],
        [{"jobs": [job()]}, {"next": None}],
        [{"jobs": {}, "next": None}],
        [{"jobs": [7], "next": None}],
        [{}],
    ],
)
def test_lists_of_jobs_that_do_not_end(run_client: ClientRunner, pages: list[Any]) -> None:
    """A repeated cursor, an empty page before the last and a page of another form are refused."""
    if pages == [{"jobs": [job()]}, {"next": None}]:
        pages = [{"jobs": [job()], "next": "a"}, {"next": None}]
    answers = iter(pages * 3)

    def service(_: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(200, json=next(answers))

    with pytest.raises(InvalidResponseError):
        run_client(lambda client: client.jobs(), service)


@pytest.mark.parametrize(
    "record",
    [
        {},
        job(id=None),
        job(state=5),
        job(progress=None),
        job(progress={}),
        job(progress={"stage": "x", "done": "1", "total": 2}),
        job(options={}),
        job(options=[]),
        job(report=[]),
        job(problem=[]),
        job(problem={}),
        job(problem={"status": "many"}),
        job(problem={"status": 7}),
    ],
)
def test_jobs_of_another_form(run_client: ClientRunner, record: dict[str, Any]) -> None:
    """A report of a job without its members is InvalidResponseError, and no KeyError."""
    for call in (lambda client: client.job("abc"), lambda client: client.submit(b"ply\n")):
        with pytest.raises(InvalidResponseError, match="describe a job"):
            run_client(call, lambda _: httpx2.Response(200, json=record))


@pytest.mark.parametrize("body", [b"[" * 100_000, b"\xff", b"3", b"null", b'{"models": 1', HTML])
@pytest.mark.parametrize("call", ["health", "models"])
def test_documents_that_are_no_object(run_client: ClientRunner, body: bytes, call: str) -> None:
    """Deep nesting, broken text and other types are InvalidResponseError."""
    with pytest.raises(InvalidResponseError):
        run_client(
            lambda client: getattr(client, call)(), lambda _: httpx2.Response(200, content=body)
        )


@pytest.mark.parametrize(
    "raw",
    [
        b"nonsense\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: many\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"HTTP/1.1 200 OK\r\n" + b"X: " + b"x" * 200_000 + b"\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: http://a..b:99999999/\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 999 \xff\xfe\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nPugeo-Points-Out: \xb2\r\nContent-Length: 2\r\n\r\n{}",
    ],
)
def test_broken_http(run_client: ClientRunner, serve: Any, raw: bytes) -> None:
    """Whatever breaks the rules of HTTP is an error of the package."""

    def script(connection: socket.socket, _: int) -> None:
        connection.recv(65536)
        connection.sendall(raw)

    with serve(script) as url, pytest.raises(PugeoError):
        run_client(lambda client: client.upsample(b"ply\n"), base_url=url, max_retries=0)


def test_the_id_of_a_lying_server_is_escaped(run_client: ClientRunner) -> None:
    """An id from an answer leads to no other route."""
    paths: list[bytes] = []

    def service(request: httpx2.Request) -> httpx2.Response:
        paths.append(request.url.raw_path)
        return httpx2.Response(200, json=job(id="../upsample?R=9"))

    async def afterwards(found: Any) -> Any:
        return await (await found).refresh()

    def call(client: Any) -> Any:
        found = client.job("a/b")
        return afterwards(found) if hasattr(found, "__await__") else found.refresh()

    run_client(call, service)
    assert paths == [b"/jobs/a%2Fb", b"/jobs/..%2Fupsample%3FR%3D9"]


def test_problems_of_another_form(run_client: ClientRunner) -> None:
    """Members of a problem that have the wrong type do no harm."""
    problem = {"code": ["x"], "detail": {"a": 1}, "request_id": 7, "retryable": "no", "status": "s"}

    def service(_: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(422, content=io.BytesIO(json.dumps(problem).encode()).getvalue())

    with pytest.raises(StatusError) as caught:
        run_client(lambda client: client.health(), service)
    assert (caught.value.request_id, caught.value.retryable) == ("7", None)
