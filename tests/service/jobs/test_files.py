# SPDX-License-Identifier: Apache-2.0
"""Files of jobs whose maker is gone."""

from pathlib import Path

from pugeo_service.jobs.files import NewFile


def test_a_thread_left_behind_writes_nothing(tmp_path: Path) -> None:
    """It belongs to somebody who was cancelled and has closed the file already."""
    file = NewFile(tmp_path / "part", tmp_path / "target")
    file.close()
    file._store(bytearray(b"late"))
    file._publish()
    assert list(tmp_path.iterdir()) == []
