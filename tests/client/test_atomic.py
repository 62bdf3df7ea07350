# SPDX-License-Identifier: Apache-2.0
import os
import stat
import threading
from pathlib import Path

import pytest

from pugeo_client._atomic import atomic_file, check_writable


def write(path: Path, data: bytes = b"new") -> None:
    with atomic_file(path) as file:
        file.write(data)


def fail_halfway(path: Path) -> None:
    with atomic_file(path) as file:
        file.write(b"half")
        file.flush()
        raise KeyError


def test_the_whole_or_the_old(tmp_path: Path) -> None:
    """A file appears or is replaced at the end of the block; an error leaves the old one."""
    target = tmp_path / "a.ply"
    write(target)
    with pytest.raises(KeyError):
        fail_halfway(target)
    assert target.read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755])
def test_permission_bits_are_kept(tmp_path: Path, mode: int) -> None:
    """A file that is replaced keeps its permission bits; a new one has those of `open`."""
    target = tmp_path / "a.ply"
    target.write_bytes(b"old")
    target.chmod(mode)
    write(target)
    assert stat.S_IMODE(target.stat().st_mode) == mode
    (tmp_path / "plain").write_bytes(b"")
    write(tmp_path / "b.ply")
    expected = (tmp_path / "plain").stat().st_mode
    assert (tmp_path / "b.ply").stat().st_mode == expected


def test_a_symbolic_link_stays(tmp_path: Path) -> None:
    """The target of a link is replaced, and the link still leads there; a broken one too."""
    for name, existing in (("old", True), ("missing", False)):
        target, link = tmp_path / "elsewhere" / name, tmp_path / f"link-{name}"
        target.parent.mkdir(exist_ok=True)
        if existing:
            target.write_bytes(b"old")
        link.symlink_to(target)
        write(link)
        assert link.is_symlink()
        assert target.read_bytes() == b"new"


def test_devices_are_not_replaced() -> None:
    """Content for a device is copied into it.

    The device is a terminal of its own: its file system holds no regular files, so that a fault
    in the code under test cannot replace a device that other programs need.
    """
    master, terminal = os.openpty()
    try:
        path = Path(os.ttyname(terminal))
        write(path, b"new")
        assert os.read(master, 100) == b"new"
        assert stat.S_ISCHR(path.stat().st_mode)
    finally:
        os.close(master)
        os.close(terminal)


def test_pipes_are_not_replaced(tmp_path: Path) -> None:
    """A reader of a named pipe gets the whole content, and nothing after an error."""
    pipe = tmp_path / "pipe.ply"
    os.mkfifo(pipe)
    received: list[bytes] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()))
    reader.start()
    with pytest.raises(KeyError):
        fail_halfway(pipe)
    write(pipe, b"x" * 200_000)
    reader.join(30)
    assert received == [b"x" * 200_000]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe.ply"]


def test_a_descriptor_of_this_process(tmp_path: Path) -> None:
    """A path below /dev or /proc that leads to an open file appends to it."""
    if not Path("/proc/self/fd").exists():
        pytest.skip("this system has no /proc")
    with (tmp_path / "log").open("wb") as log:
        log.write(b"before,")
        log.flush()
        write(Path(f"/proc/self/fd/{log.fileno()}"), b"after")
        inode = os.fstat(log.fileno()).st_ino
    assert (tmp_path / "log").read_bytes() == b"before,after"
    assert (tmp_path / "log").stat().st_ino == inode


def test_a_name_as_long_as_allowed(tmp_path: Path) -> None:
    """The temporary file has a short name of its own."""
    target = tmp_path / ("x" * 251 + ".ply")
    write(target)
    assert target.read_bytes() == b"new"


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    """A folder, and a folder that does not exist, are refused before any work."""
    with pytest.raises(IsADirectoryError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        check_writable(tmp_path / "nowhere" / "a.ply")
    check_writable(tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_rights_that_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file without the right to write is refused, although a rename could replace it."""
    target = tmp_path / "a.ply"
    target.write_bytes(b"old")
    # Root may write everything, so that permission bits alone would prove nothing.
    monkeypatch.setattr("pugeo_client._atomic.os.access", lambda path, _: Path(path) != target)
    with pytest.raises(PermissionError, match="cannot be written"):
        write(target)
    assert target.read_bytes() == b"old"
