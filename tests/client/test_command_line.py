# SPDX-License-Identifier: Apache-2.0
"""The service of ``pugeo upsample --url``, against a server that answers as the service does."""

import io
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from pugeo_client._command_line import CommandLineService

HEADERS = {
    "Pugeo-Points-In": "3", "Pugeo-Points-Out": "2", "Pugeo-Dropped-Non-Finite": "1",
    "Pugeo-Dropped-Duplicate": "0", "Pugeo-Notes": '["A guess."]',
}  # fmt: skip
DENSE = b"1 2 3\n4 5 6\n"
OPTIONS: dict[str, Any] = {"ratio": 2.0, "orient": "mst", "viewpoint": (0.0, 0.0, 1.0), "seed": 1}


class Server(ThreadingHTTPServer):
    """Notes each request: method, path, query, body."""

    asked: list[tuple[str, str, dict[str, list[str]], bytes]]


class Handler(BaseHTTPRequestHandler):
    """Answers requests for clouds and jobs."""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self._note("POST", body)
        if urlsplit(self.path).path == "/jobs":
            self._answer(202, json.dumps(_job("queued")).encode())
        else:
            self._answer(200, DENSE, **HEADERS)

    def do_GET(self) -> None:
        self._note("GET", b"")
        if self.path.endswith("/result"):
            self._answer(200, DENSE, **HEADERS)
        else:
            self._answer(200, json.dumps(_job("succeeded")).encode())

    def _note(self, method: str, body: bytes) -> None:
        parts = urlsplit(self.path)
        assert isinstance(self.server, Server)
        self.server.asked.append((method, parts.path, parse_qs(parts.query), body))

    def _answer(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


def _job(state: str) -> dict[str, Any]:
    return {
        "id": "one", "state": state, "progress": {"stage": "predict", "done": 1, "total": 1},
        "format": "xyz", "options": {"format": "xyz"}, "problem": None, "report": None,
    }  # fmt: skip


@pytest.fixture
def server() -> Iterator[Server]:
    """A server on a free port."""
    with Server(("127.0.0.1", 0), Handler) as running:
        running.asked = []
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.mark.parametrize("as_jobs", [False, True])
def test_a_file(server: Server, tmp_path: Path, as_jobs: bool) -> None:
    """A file is sent with its options, the answer is written, and its headers are the report."""
    (tmp_path / "a.xyz").write_bytes(b"0 0 0\n1 0 0\n0 1 0\n")
    service = CommandLineService(f"http://127.0.0.1:{server.server_port}", as_jobs=as_jobs)
    stages: list[str] = []
    report = service.upsample(
        tmp_path / "a.xyz",
        tmp_path / "dense.xyz",
        "xyz",
        OPTIONS,
        lambda stage, _done, _total: stages.append(stage),
    )
    assert (tmp_path / "dense.xyz").read_bytes() == DENSE
    assert report == {
        "points_in": 3, "points_out": 2, "dropped": {"non_finite": 1, "duplicate": 0},
        "notes": ["A guess."],
    }  # fmt: skip
    method, path, query, body = server.asked[0]
    assert (method, path) == ("POST", "/jobs" if as_jobs else "/upsample")
    assert (query["R"], query["format"], query["viewpoint"]) == (["2.0"], ["xyz"], ["0.0,0.0,1.0"])
    assert body == (tmp_path / "a.xyz").read_bytes()
    assert {"send", "receive"} <= set(stages)


def test_a_stream(server: Server) -> None:
    """A stream is sent, and the answer goes into another one."""
    target = io.BytesIO()
    service = CommandLineService(f"http://127.0.0.1:{server.server_port}", as_jobs=False)
    service.upsample(io.BytesIO(b"0 0 0\n"), target, "xyz", OPTIONS, lambda *_: None)
    assert target.getvalue() == DENSE


def test_errors(tmp_path: Path) -> None:
    """An address without a service is an error that names it and the way to start one."""
    (tmp_path / "a.ply").touch()
    service = CommandLineService("http://127.0.0.1:9", as_jobs=False)
    with pytest.raises(service.error_type, match=r"127\.0\.0\.1:9.*pugeo serve"):
        service.upsample(tmp_path / "a.ply", tmp_path / "b.ply", "ply", OPTIONS, lambda *_: None)
    with pytest.raises(CommandLineService.error_type, match="ftp"):
        CommandLineService("ftp://there", as_jobs=False)
