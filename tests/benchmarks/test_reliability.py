# SPDX-License-Identifier: Apache-2.0
"""The harnesses notice what they are there to notice; a small dose of each is part of every run."""

import argparse
import asyncio
import io
import itertools
import json
import math
import mmap
import random
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("benchmarks", reason="not part of a source distribution")

from benchmarks.reliability import disk, faults, floods, fuzz, hostile, trial
from benchmarks.reliability.clouds import Book, ask
from benchmarks.reliability.corpus import corpus
from benchmarks.reliability.http import faults_in
from benchmarks.reliability.processes import psutil
from benchmarks.reliability.verdict import Claim, quantile, verdict
from tests.service.engine.standard import STANDARD

from pugeo_model import Cloud, formats
from pugeo_model.errors import LimitExceededError
from pugeo_model.formats import FORMATS
from pugeo_service.engine import stages
from pugeo_service.http.request_limits import encode_response
from pugeo_service.problems import ProblemError
from pugeo_service.runs import make_run_request
from pugeo_service.settings import Settings

# A thousand inputs of those with which every warning is an error.
START, STOP = 1_000, 2_000


@pytest.fixture(name="place")
def _place() -> mmap.mmap:
    return mmap.mmap(-1, 8)


@pytest.mark.slow
def test_broken_files(place: mmap.mmap) -> None:
    """A thousand, through all readers: a cloud or a CloudError, for little memory and time."""
    found = trial.run(0, (), START, STOP, place)
    assert found.findings == []
    assert sum(found.outcomes.values()) == STOP - START
    assert {key.split()[0] for key in found.outcomes} == set(corpus())
    # Reached deep enough: every kind is still read at times, and refused for several reasons.
    for kind in corpus():
        assert f"{kind} read" in found.outcomes
        assert sum(key.startswith(f"{kind} ") for key in found.outcomes) > 4


def test_every_file_of_the_corpus_is_valid() -> None:
    """Mutations start from what the readers take, in every format that can be told from others."""
    told = set()
    for kind, files in corpus().items():
        for data in files:
            # The header of a binary STL file is any text: only its name tells the format.
            named = "stl" if kind == "stl" and not data.startswith(b"solid") else None
            told.add(named or formats.detect(io.BytesIO(data)))
            assert len(formats.read(io.BytesIO(data), format=named, limits=trial.LIMITS)) > 0
    assert told == set(FORMATS)


def test_inputs_can_be_replayed() -> None:
    """The same seed and number give the same bytes, another seed others."""
    first, again, other = (trial.inputs(seed) for seed in (3, 3, 4))
    assert [first(i) for i in range(50)] == [again(i) for i in range(50)]
    assert [first(i) for i in range(50)] != [other(i) for i in range(50)]


@pytest.mark.parametrize("fault", ["raise", "hoard", "linger"])
def test_findings(monkeypatch: pytest.MonkeyPatch, place: mmap.mmap, fault: str) -> None:
    """Another exception, too much memory and too much time are noted, with the input's number."""
    honest, count = formats.read, itertools.count(1)
    # Each valid file is read first; then the third of the inputs is the one.
    guilty = 3 + sum(map(len, corpus().values()))

    def faulty(source: Any, **options: Any) -> Cloud:
        if next(count) == guilty:
            if fault == "raise":
                raise ZeroDivisionError
            if fault == "hoard":
                bytearray(64 << 20)
        return honest(source, **options)

    monkeypatch.setattr(formats, "read", faulty)
    if fault == "linger":
        clock = itertools.count(0.0, 1.5)
        monkeypatch.setattr(time, "thread_time", lambda: next(clock))
        monkeypatch.setattr(trial, "SECONDS", 1.0)
    found = trial.run(0, (), 100, 104, place).findings
    if fault == "linger":
        assert [one["index"] for one in found] == [100, 101, 102, 103]
        assert "took 1.5 s" in found[0]["what"]
    else:
        assert [one["index"] for one in found] == [102]
        assert ("ZeroDivisionError" if fault == "raise" else "bytes for a file") in found[0]["what"]


def answer(points: NDArray[np.float64]) -> bytes:
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(points.astype(np.float32), normals.astype(np.float32)), buffer)
    return buffer.getvalue()


def test_wrong_answers_are_found_out() -> None:
    """A point too few, a point off the surface, and other bytes than last time are wrong."""
    asked = ask(500, ratio=1.5)
    directions = np.random.default_rng(1).normal(size=(asked.points_out, 3))
    right = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    off = right.copy()
    off[7] *= 1.0 + 0.11 * math.sqrt(4.0 * math.pi / 500)
    book = Book()
    assert not book.check(asked, answer(right[1:]))
    assert not book.check(asked, answer(off))
    assert book.check(asked, answer(right))
    assert book.check(asked, answer(right))
    assert not book.check(asked, answer(right[::-1]))
    assert [fault.partition(": ")[2] for fault in book.wrong] == [
        "749 points, not 750",
        "a point is 0.11 spacings off the sphere",
        "other bytes than the same request had before",
    ]


@pytest.mark.parametrize("holds", [True, False])
def test_the_status_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str], holds: bool) -> None:
    """A claim that fails makes the status 1 and says so, in the table and in the file."""
    claims = [Claim("water is wet", "it is", True), Claim("all is well", "hardly", holds)]
    status = verdict("name", tmp_path, claims, [("figure", "1")], {"seed": 1}, [0])
    assert status == (0 if holds else 1)
    assert ("| all is well | hardly | FAILS |" in capsys.readouterr().out) is not holds
    written = json.loads((tmp_path / "name.json").read_text())
    assert (written["holds"], written["seed"], written["figures"]) == (holds, 1, {"figure": "1"})


def test_quantiles() -> None:
    """The 99th percentile of a hundred values is the second largest, of few the largest."""
    assert quantile(list(range(100)), 0.99) == 98
    assert quantile([3.0, 1.0, 2.0], 0.99) == 3.0
    assert quantile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert math.isnan(quantile([], 0.5))


Attack = Callable[[hostile.Address, random.Random], Awaitable[tuple[str, ...]]]


def answers_to(attack: Attack, answer: bytes) -> tuple[str, ...]:
    """Return the answers that an attack reports of a service which always sends the same."""

    async def one(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer)
        writer.close()
        await writer.wait_closed()

    async def run() -> tuple[str, ...]:
        async with await asyncio.start_server(one, "127.0.0.1", 0) as server:
            return await attack(server.sockets[0].getsockname(), random.Random(0))

    return asyncio.run(run())


def test_refusals_are_no_faults() -> None:
    """A 501 and too many connections are refusals; another 503 and a 500 are faults."""
    problems = [
        ProblemError(503, "too_many_connections", "text", retry_after=5),
        ProblemError(501, "unsupported_transfer_coding", "text", retryable=False),
        ProblemError(503, "engine_lost", "text", retry_after=5),
        ProblemError(408, "slow", "text"),
    ]
    answer = b"".join(map(encode_response, problems)) + b"HTTP/1.1 500 Oh\r\n\r\n"
    told = answers_to(hostile.half_open, answer)
    assert told == (
        "503 too_many_connections", "501 unsupported_transfer_coding", "503 engine_lost", "408",
        "500",
    )  # fmt: skip
    assert faults_in(dict.fromkeys(told, 3)) == 6


def test_columns_are_many_and_small() -> None:
    """The archive of a thousand columns has some 300 KB, and its answer too many bytes."""
    body = floods.columns()
    assert len(body) < 400_000
    order = make_run_request(
        Settings(), {"ratio": 32.0}, model=STANDARD, format=None, answer="ply", deadline_s=9.0
    )
    with pytest.raises(LimitExceededError, match="bytes") as caught:
        stages.prepare(np.frombuffer(body, np.uint8), order)
    assert caught.value.code == "too_many_output_bytes"
    few = formats.read(io.BytesIO(floods.columns(10, 3)), limits=trial.LIMITS)
    assert list(few.scalars) == ["s0", "s1", "s2"]


def test_kinds_of_faults() -> None:
    """Shares of the whole service and of stopped workers; the others are killed."""
    kinds = [faults.choose(chance / 100, 0.25, 0.15) for chance in range(100)]
    shares = {kind: kinds.count(kind) for kind in kinds}
    assert shares == {"service": 25, "stopped worker": 15, "worker": 60}


@pytest.mark.parametrize("ended", [True, False])
def test_a_stopped_worker_that_nobody_ends(ended: bool) -> None:
    """It is told of, and goes on, so that the run can end."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        worker = psutil.Process(process.pid)
        worker.suspend()
        if ended:
            worker.kill()
        assert faults.replaced(worker, 0.1 if not ended else 60.0) is ended
        if not ended:
            assert worker.status() != psutil.STATUS_STOPPED
        process.kill()


def test_a_small_disk_is_full_and_has_room_again() -> None:
    """It is filled to the last byte, and empty without the file."""
    if lack := disk.missing():
        pytest.skip(lack)
    with disk.small_disk(1 << 20) as folder:
        assert disk.fill(folder / "filler") == 1 << 20
        with pytest.raises(OSError, match="No space left"):
            (folder / "more").write_bytes(b"x")
        (folder / "more").unlink()
        (folder / "filler").unlink()
        (folder / "more").write_bytes(bytes(100_000))
    assert not folder.exists()


def test_traces_of_a_library_do_not_count_as_growth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The process that reads prints none, whatever the shell has set."""
    monkeypatch.setenv("RUST_BACKTRACE", "1")
    seen = tmp_path / "seen"
    script = f"#!/bin/sh\necho $RUST_BACKTRACE > {seen}\nexit 1\n"
    (tmp_path / "python").write_text(script, "utf-8")
    (tmp_path / "python").chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    options = argparse.Namespace(replay=None, inputs=1, seed=1, kinds="", out=tmp_path)
    assert fuzz.main(options) == 1
    assert seen.read_text("utf-8") == "0\n"
