# SPDX-License-Identifier: Apache-2.0
"""Atomic files whose writer was cancelled while a thread still stores."""

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.storage.atomic_file import AtomicFile


def test_a_late_thread_writes_nothing(tmp_path: Path) -> None:
    """After `close`, storing and publishing have no effect."""
    file = AtomicFile(tmp_path / "part", tmp_path / "target")
    file.close()
    file._store(bytearray(b"late"))
    file._publish()
    assert list(tmp_path.iterdir()) == []


def test_close_does_not_wait_for_a_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`close` returns while the disk blocks; the thread then removes the part."""
    begun, go_on, opened = threading.Event(), threading.Event(), os.open

    def slow(path: Any, *args: Any) -> int:
        begun.set()
        go_on.wait()
        return opened(path, *args)

    monkeypatch.setattr(os, "open", slow)
    file = AtomicFile(tmp_path / "part", tmp_path / "target")
    thread = threading.Thread(target=file._store, args=(bytearray(b"late"),), daemon=True)
    thread.start()
    begun.wait()
    file.close()
    assert thread.is_alive()
    go_on.set()
    thread.join()
    assert list(tmp_path.iterdir()) == []
