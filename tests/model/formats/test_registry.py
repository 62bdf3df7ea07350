# SPDX-License-Identifier: Apache-2.0
"""Finding the format, paths and streams, and hostile bytes for every reader."""

import contextlib
import io
import os
import stat
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pugeo_model import (
    Cloud,
    CloudError,
    LimitExceededError,
    MalformedFileError,
    UnsupportedFormatError,
)
from pugeo_model.formats import (
    FORMATS,
    WRITABLE,
    Limits,
    detect,
    dropped,
    output_format,
    read,
    write,
)

Dump = Callable[[Cloud, str], bytes]


def test_names() -> None:
    """The registry has the promised names, and every extension belongs to one format."""
    names = sorted(FORMATS)
    assert names == [
        *("e57", "json", "las", "laz", "npy", "npz", "obj", "pcd", "ply", "ply-ascii", "ptx"),
        *("stl", "xyz"),
    ]
    assert set(FORMATS) - set(WRITABLE) == {"obj", "stl"}
    for key, module in FORMATS.items():
        assert key == module.NAME
        assert module.MEDIA_TYPES
    endings = [ending for module in FORMATS.values() for ending in module.EXTENSIONS]
    assert len(set(endings)) == len(endings)
    assert all(ending == ending.lower() and ending[0] == "." for ending in endings)


@pytest.mark.parametrize("name", sorted(WRITABLE))
def test_content_is_recognised(name: str, rich: Cloud, dump: Dump) -> None:
    """A written file is recognised by its content, and the file does not move."""
    file = io.BytesIO(dump(rich, name))
    assert detect(file) == name
    assert file.tell() == 0
    # The content is believed before the name.
    assert detect(file, name="wrong.npz") == name


@pytest.mark.parametrize("name", sorted(WRITABLE))
def test_kinds_of_files(name: str, rich: Cloud, dump: Dump, tmp_path: Path) -> None:
    """Paths, text paths, real, spooled and in-memory files, and pipes all read the same."""
    data = dump(rich, name)
    path = tmp_path / "cloud"
    path.write_bytes(data)
    receiver, sender = os.pipe()
    with (
        tempfile.SpooledTemporaryFile(1 << 20) as small,
        tempfile.SpooledTemporaryFile(1) as large,
        os.fdopen(receiver, "rb") as pipe,
        path.open("rb") as real,
    ):
        for spooled in (small, large):
            spooled.write(data)
            spooled.seek(0)

        def feed() -> None:
            with os.fdopen(sender, "wb") as end:
                end.write(data)

        feeder = threading.Thread(target=feed)
        feeder.start()
        for source in (path, str(path), real, small, large, io.BytesIO(data), pipe):
            np.testing.assert_allclose(read(source).points, rich.points, atol=6e-7)
        feeder.join()


def test_endless_pipe() -> None:
    """A stream without end is cut off at the limit."""
    receiver, sender = os.pipe()

    def feed() -> None:
        with os.fdopen(sender, "wb", buffering=0) as end:
            try:
                while True:
                    end.write(b"0 0 0\n" * 1000)
            except BrokenPipeError:
                return

    feeder = threading.Thread(target=feed)
    feeder.start()
    with os.fdopen(receiver, "rb") as pipe, pytest.raises(LimitExceededError):
        read(pipe, limits=Limits(max_bytes=1_000_000))
    pipe.close()
    feeder.join()


def test_unknown_content(tmp_path: Path) -> None:
    """Content and names that say nothing, and unknown formats, are refused with what there is."""
    for data in (b"\x89PNG\r\n\x1a\n", b"hello world this\n", b"\x00" * 100, b"[[1,2,3]]"):
        with pytest.raises(UnsupportedFormatError, match="Readable are ply-ascii, ply"):
            read(io.BytesIO(data))
    with pytest.raises(UnsupportedFormatError, match="no format 'dxf'"):
        read(io.BytesIO(b"x"), format="dxf")
    with pytest.raises(UnsupportedFormatError, match="extension"):
        write(Cloud(np.zeros((1, 3))), tmp_path / "cloud.dxf")
    with pytest.raises(UnsupportedFormatError, match="extension"):
        write(Cloud(np.zeros((1, 3))), tmp_path / "cloud.obj")
    with pytest.raises(UnsupportedFormatError, match="is read only"):
        write(Cloud(np.zeros((1, 3))), io.BytesIO(), format="stl")
    with pytest.raises(MalformedFileError, match="empty"):
        read(io.BytesIO())


def test_extension_decides_last(tmp_path: Path) -> None:
    """The extension decides for unknown content, and its reader names the fault."""
    path = tmp_path / "cloud.PLY"
    path.write_bytes(b"not a ply file")
    with pytest.raises(MalformedFileError, match="'ply'"):
        read(path)


def test_format_of_a_path(rich: Cloud, tmp_path: Path) -> None:
    """The extension chooses the writer; without one it is PLY; a format given overrides both."""
    for name, asked, expected in (
        ("a.npz", None, "npz"),
        ("a.json", None, "json"),
        ("a.csv", None, "xyz"),
        ("a.ply", None, "ply"),
        ("a", None, "ply"),
        ("b.ply", "ply-ascii", "ply-ascii"),
        ("b.dxf", "npz", "npz"),
        ("a.laz", None, "laz"),
        ("a.pcd", None, "pcd"),
    ):
        write(rich, tmp_path / name, format=asked)
        with (tmp_path / name).open("rb") as file:
            assert detect(file) == expected


def test_write_is_all_or_nothing(
    rich: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failure half way leaves the old file and no debris."""
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")

    def fail(_: Cloud, file: io.BufferedWriter) -> None:
        file.write(b"half")
        raise RuntimeError("disk on fire")

    monkeypatch.setattr(FORMATS["ply"], "write", fail)
    with pytest.raises(RuntimeError, match="fire"):
        write(rich, path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    write(rich, path)
    assert len(read(path)) == 7
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_and_links(rich: Cloud, tmp_path: Path) -> None:
    """New files have the rights of any new file, and a link goes on pointing to its file."""
    plain, path, link = tmp_path / "plain", tmp_path / "cloud.ply", tmp_path / "link.ply"
    plain.touch()
    link.symlink_to(path)
    write(rich, link)
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_missing_paths(rich: Cloud, tmp_path: Path) -> None:
    """Paths that are not there raise what Python raises."""
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none.ply")
    with pytest.raises(FileNotFoundError):
        write(rich, tmp_path / "none" / "cloud.ply")


def test_output_format() -> None:
    """An answer has its input's format, or PLY where that is read only or there is no file."""
    assert [output_format(name) for name in (None, "stl", "obj", "laz", "ply-ascii", "xyz")] == [
        *("ply", "ply", "ply", "laz", "ply-ascii", "xyz")
    ]


@pytest.mark.parametrize("name", sorted(WRITABLE))
def test_nothing_is_dropped_silently(name: str, rich: Cloud, dump: Dump) -> None:
    """Every attribute comes back, or the note on dropped attributes names it."""
    assert rich.normals is not None
    assert rich.colors is not None
    lengths = np.linalg.norm(rich.normals, axis=1, keepdims=True)
    rich = replace(rich, normals=(rich.normals / lengths).astype(np.float32))
    back = read(io.BytesIO(dump(rich, name)))
    note = dropped(rich, name) or ""
    assert back.source is not None
    assert back.source.format == name
    assert (back.normals is not None) == ("normals" not in note)
    assert back.colors is not None
    assert (back.colors.shape[1] == 4) == ("alpha" not in note)
    for scalar in rich.scalars:
        plain = scalar.lower().removeprefix("scalar_")
        known = {"class": "classification", "time": "gps_time"}
        names = {each.lower().removeprefix("scalar_") for each in back.scalars}
        assert scalar in note or plain in names or known.get(plain) in names, scalar


@pytest.mark.parametrize("name", sorted(WRITABLE))
@given(data=st.data())
def test_hostile_bytes(name: str, data: st.DataObject) -> None:
    """Damaged files raise a CloudError or read as something: never another exception."""
    rng = np.random.default_rng(3)
    cloud = Cloud(
        rng.random((5, 3)),
        rng.random((5, 3)).astype(np.float32),
        rng.integers(0, 9, (5, 3)).astype(np.uint8),
        {"depth": rng.random(5), "label": np.arange(5)},
    )
    buffer = io.BytesIO()
    write(cloud, buffer, format=name)
    damaged = bytearray(buffer.getvalue())
    place = st.integers(0, len(damaged) - 1)
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(place)
        piece = data.draw(
            st.binary(max_size=8) | st.sampled_from([b"-1", b"99999999", b"\n", b" "])
        )
        cut = data.draw(st.integers(0, 8))
        damaged[where : where + cut] = piece
    damaged = damaged[: data.draw(st.sampled_from([len(damaged), len(damaged) - 7, 60]))]
    with contextlib.suppress(CloudError):
        result = read(io.BytesIO(bytes(damaged)), format=name, limits=Limits(max_points=1000))
        assert len(result) <= 1000


@given(junk=st.binary(max_size=200), start=st.sampled_from([b"", b"ply\n", b"PK\x03\x04", b"{"]))
def test_junk(junk: bytes, start: bytes) -> None:
    """Bytes of any kind, under any format, raise a CloudError or read as something."""
    for name in (None, *FORMATS):
        with contextlib.suppress(CloudError):
            result = read(io.BytesIO(start + junk), format=name, limits=Limits(max_points=1000))
            assert len(result) <= 1000


def test_notes_are_bounded() -> None:
    """A file with hundreds of columns without a name gives short notes."""
    row = " ".join(["1.5"] * 200)
    notes = read(io.BytesIO(f"{row}\n{row}\n{row}\n".encode()), format="xyz").notes
    assert len(notes) <= 51
    assert all(len(note) <= 500 for note in notes)
