# SPDX-License-Identifier: Apache-2.0
"""Files of jobs whose maker is gone."""

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.jobs.files import NewFile


def test_a_thread_left_behind_writes_nothing(tmp_path: Path) -> None:
    """It belongs to somebody who was cancelled and has closed the file already."""
    file = NewFile(tmp_path / "part", tmp_path / "target")
    file.close()
    file._store(bytearray(b"late"))
    file._publish()
    assert list(tmp_path.iterdir()) == []


def test_nobody_waits_for_a_thread_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closing returns at once while the disk hangs, and the thread cleans up after itself."""
    begun, go_on, opened = threading.Event(), threading.Event(), os.open

    def slow(path: Any, *args: Any) -> int:
        begun.set()
        assert go_on.wait(10)
        return opened(path, *args)

    monkeypatch.setattr(os, "open", slow)
    file = NewFile(tmp_path / "part", tmp_path / "target")
    thread = threading.Thread(target=file._store, args=(bytearray(b"late"),))
    thread.start()
    assert begun.wait(10)
    start = time.monotonic()
    file.close()
    assert time.monotonic() - start < 1
    go_on.set()
    thread.join(10)
    assert list(tmp_path.iterdir()) == []
