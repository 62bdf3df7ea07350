# SPDX-License-Identifier: Apache-2.0
"""Small clouds in files, and the command run in this process."""

import io
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.cli import main
from pugeo_model.formats import write


@dataclass(frozen=True)
class Done:
    """The end of a command: exit status, what it printed on stdout as bytes, and on stderr."""

    status: int
    stdout: bytes
    stderr: str


@pytest.fixture
def pugeo(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Done]:
    """Runs the command: ``pugeo("info", path, stdin=b"...")``."""

    def run(*arguments: object, stdin: bytes = b"") -> Done:
        out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.StringIO()
        with monkeypatch.context() as patched:
            patched.setattr(sys, "argv", ["pugeo", *map(str, arguments)])
            patched.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin)))
            patched.setattr(sys, "stdout", out)
            patched.setattr(sys, "stderr", err)
            with pytest.raises(SystemExit) as ended:
                main()
            out.flush()
        status: Any = ended.value.code
        printed = out.buffer
        assert isinstance(printed, io.BytesIO)
        return Done(status or 0, printed.getvalue(), err.getvalue())

    return run


@pytest.fixture
def scan(tmp_path: Path) -> Callable[..., Path]:
    """Writes a file of 300 points of a sphere: ``scan("a.laz")``."""

    def make(name: str, count: int = 300) -> Path:
        points = np.random.default_rng(len(name)).normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        labels = {"classification": np.arange(count, dtype=np.uint8) % 5}
        write(Cloud(10 * points, scalars=labels), path)
        return path

    return make
