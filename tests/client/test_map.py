# SPDX-License-Identifier: Apache-2.0
"""`map` of both clients, against a function in the place of a service."""

import contextlib
import io
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from pugeo_client import Client, Result
from pugeo_client.errors import SourceError, UnprocessableError

ClientRunner = Callable[..., Any]


@pytest.fixture
def service(ply_bytes: bytes) -> Callable[[httpx2.Request], httpx2.Response]:
    """Returns the same cloud for each request, with its body as request id; refuses `bad`."""

    def answer(request: httpx2.Request) -> httpx2.Response:
        if request.content == b"bad":
            return httpx2.Response(422, json={"code": "x", "detail": "why"})
        headers = {"X-Request-ID": request.content.decode(), "Pugeo-Points-Out": "3"}
        headers["Pugeo-Model-Version"] = str(request.url.params)
        return httpx2.Response(200, headers=headers, content=ply_bytes)

    return answer


def test_order_and_options(run_client: ClientRunner, service: Any) -> None:
    """Results come in the order of the sources, each with the shared options."""
    names = [str(number).encode() for number in range(9)]
    results = run_client(lambda client: client.map(names, 2, concurrency=3, seed=5), service)
    assert [result.meta.request_id for result in results] == [name.decode() for name in names]
    assert {result.meta.model_version for result in results} == {
        "orient=auto&seed=5&format=ply&R=2.0"
    }


def test_a_failure_is_yielded_in_its_place(
    run_client: ClientRunner, service: Any, tmp_path: Path
) -> None:
    """Errors of the service, of a source and of a file come in order, and the others go on."""
    missing = tmp_path / "missing.ply"
    sources = [b"1", b"bad", 42, missing, b"2"]
    results = run_client(lambda client: client.map(sources, concurrency=2), service)
    assert [type(result) for result in results] == [
        Result, UnprocessableError, SourceError, FileNotFoundError, Result
    ]  # fmt: skip
    assert results[1].__notes__ == ["source 1: bytes"]
    assert results[3].__notes__ == [f"source 3: {missing}"]
    mistaken = run_client(lambda client: client.map([b"1"], R=4, n_points=9), service)
    assert [type(result) for result in mistaken] == [SourceError]


def test_a_folder_of_files(run_client: ClientRunner, service: Any, tmp_path: Path) -> None:
    """Each source gets a file of its own name, and format if that is written, in a new folder."""
    for name in ("a.laz", "b.obj", "bad.ply"):
        (tmp_path / name).write_bytes(name.split(".")[0].encode())
    opened = io.BytesIO(b"opened")
    opened.name = "scans/c.xyz.ply"
    out = tmp_path / "dense" / "here"
    sources = [tmp_path / "a.laz", str(tmp_path / "b.obj"), tmp_path / "bad.ply", opened, b"raw"]
    results = run_client(lambda client: client.map(sources, out=out, concurrency=2), service)
    assert [path.name for path in sorted(out.iterdir())] == [
        "a.laz", "b.ply", "c.xyz.ply", "cloud-000004.ply"
    ]  # fmt: skip
    assert [getattr(result, "path", None) for result in results] == [
        out / "a.laz", out / "b.ply", None, out / "c.xyz.ply", out / "cloud-000004.ply"
    ]  # fmt: skip
    assert [results[0].meta.request_id, results[1].meta.request_id] == ["a", "b"]


def test_the_format_of_the_files(run_client: ClientRunner, tmp_path: Path) -> None:
    """`format=` goes before the extension of the source, which goes before PLY."""
    asked: list[str] = []

    def service(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.url.params["format"])
        return httpx2.Response(200, content=b"# x y z\n1 2 3\n")

    (tmp_path / "a.ply").write_bytes(b"ply")
    (tmp_path / "b.xyz").write_bytes(b"1 2 3")
    out = tmp_path / "out"
    run_client(lambda client: client.map([tmp_path / "a.ply"], out=out, format="xyz"), service)
    run_client(lambda client: client.map([tmp_path / "b.xyz"], out=out), service)
    assert asked == ["xyz", "xyz"]
    assert {path.name for path in out.iterdir()} == {"a.xyz", "b.xyz"}


def test_names_that_clash(run_client: ClientRunner, service: Any, tmp_path: Path) -> None:
    """No file is written twice, also where only the case differs, and no source is replaced."""
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "scan.ply").write_bytes(folder.encode())
    (tmp_path / "two" / "SCAN.ply").write_bytes(b"upper")
    out = tmp_path / "out"
    sources = [tmp_path / name for name in ("one/scan.ply", "two/scan.ply", "two/SCAN.ply")]
    results = run_client(lambda client: client.map(sources, out=out, concurrency=1), service)
    assert [type(result) for result in results] == [Result, SourceError, SourceError]
    assert len(list(out.iterdir())) == 1
    (onto,) = run_client(lambda client: client.map(sources[:1], out=tmp_path / "one"), service)
    assert isinstance(onto, SourceError)
    assert (tmp_path / "one" / "scan.ply").read_bytes() == b"one"


def test_an_output_folder_that_is_a_file(
    run_client: ClientRunner, service: Any, tmp_path: Path
) -> None:
    """`out` of `map` is a folder; a file of that name is an error before the first request."""
    (tmp_path / "dense.ply").write_bytes(b"older")
    with pytest.raises(FileExistsError):
        run_client(lambda client: client.map([b"1"], out=tmp_path / "dense.ply"), service)
    assert (tmp_path / "dense.ply").read_bytes() == b"older"


def test_results_wait_in_bounds(service: Any) -> None:
    """No more sources are taken than there are calls at a time, until a result is taken."""
    taken: list[int] = []

    def sources() -> Any:
        for number in range(100):
            taken.append(number)
            yield str(number).encode()

    transport = httpx2.MockTransport(service)
    with httpx2.Client(transport=transport) as http, Client(http_client=http) as client:
        results = client.map(sources(), concurrency=3)
        next(results)
        assert len(taken) == 3
        next(results)
        assert len(taken) == 4


def test_leaving_the_loop_interrupts_the_rest(serve: Any, ply_bytes: bytes) -> None:
    """Calls that still run are interrupted at once; the service sees their connections end."""
    ended = threading.Semaphore(0)
    all_sent = threading.Barrier(3)

    def script(connection: socket.socket, _: int) -> None:
        request = connection.recv(65536)
        while not request.endswith(b"fast") and not request.endswith(b"slow"):
            request += connection.recv(65536)
        all_sent.wait(30)
        if request.endswith(b"fast"):
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(ply_bytes))
            connection.sendall(ply_bytes)
        with contextlib.suppress(OSError):
            assert connection.recv(1) == b""
        ended.release()

    with serve(script) as url, Client(url) as client:
        for result in client.map([b"fast", b"slow", b"slow"], concurrency=3):
            assert isinstance(result, Result)
            break
        # The two slow ones; that of the fast call stays open for the next one.
        assert ended.acquire(timeout=30)
        assert ended.acquire(timeout=30)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of another kind")
def test_ctrl_c_ends_map(serve: Any, tmp_path: Path) -> None:
    """A program in `map` ends at Ctrl-C, with KeyboardInterrupt, and leaves no temporary file."""
    begun = threading.Semaphore(0)

    def script(connection: socket.socket, _: int) -> None:
        connection.recv(65536)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\nply\n")
        begun.release()
        with contextlib.suppress(OSError):
            connection.recv(65536)
            connection.recv(1)

    program = (
        # A shell lets programs in its background ignore the signal.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import sys; from pugeo_client import Client\n"
        "list(Client(sys.argv[1]).map([b'1', b'2', b'3'], out=sys.argv[2], concurrency=3))"
    )
    with serve(script) as url:
        command = [sys.executable, "-c", program, url, str(tmp_path / "out")]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
            try:
                assert all(begun.acquire(timeout=60) for _ in range(3))
                process.send_signal(signal.SIGINT)
                # Without the interruption it would wait for the timeout of the calls, 600 s.
                _, stderr = process.communicate(timeout=60)
            finally:
                process.kill()
    assert b"KeyboardInterrupt" in stderr
    assert list((tmp_path / "out").iterdir()) == []
