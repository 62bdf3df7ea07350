# SPDX-License-Identifier: Apache-2.0
"""``pugeo upsample`` with several files, pipes and outputs that exist."""

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pugeo_model.formats import read, write

Run = Callable[..., Any]


def test_a_folder_keeps_names_and_formats(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """Each file of a folder is written under its name in its format, with its attributes."""
    names = ("a.laz", "b.ply", "sub/c.npz", "d.xyz")
    for name in names:
        scan(f"scans/{name}")
    done = pugeo("upsample", tmp_path / "scans", "-o", tmp_path / "dense", "-R", 2, "--workers", 1)
    assert done.status == 0, done.stderr
    assert "4 written, 0 skipped, 0 failed: 2,400 points" in done.stderr
    for name in names:
        before, after = read(tmp_path / "scans" / name), read(tmp_path / "dense" / name)
        assert len(after) == 600
        assert after.source is not None
        assert before.source is not None
        assert after.source.format == before.source.format


def test_one_bad_file_does_not_end_the_run(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """A broken and a missing file are named with their reasons, and the status is 3."""
    good, cut = scan("a.laz"), scan("b.laz")
    cut.write_bytes(cut.read_bytes()[:-200])
    out = f"{tmp_path / 'dense'}/"
    done = pugeo("upsample", cut, good, tmp_path / "none.laz", "-o", out, "-R", 2, "--json")
    assert done.status == 3
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert {Path(each["file"]).name: each["status"] for each in lines[:-1]} == {
        "a.laz": "written", "b.laz": "failed", "none.laz": "failed",
    }  # fmt: skip
    assert lines[-1]["summary"]["written"] == 1
    assert f"error: {cut} (laz): " in done.stderr
    assert "none.laz: No such file" in done.stderr
    assert sorted(path.name for path in Path(out).iterdir()) == ["a.laz"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="needs /dev/fd")
@pytest.mark.parametrize("suffix", ["ply", "laz", "npz"])
def test_descriptors_are_written_and_not_replaced(
    pugeo: Run, scan: Run, tmp_path: Path, suffix: str
) -> None:
    """A pipe, a named pipe, and a file that others append to (``>> log``) get the cloud."""
    source = scan(f"a.{suffix}")
    fifo, log = tmp_path / "fifo", tmp_path / "log"
    os.mkfifo(fifo)
    log.write_bytes(b"old")
    inode = log.stat().st_ino
    reader, writer = os.pipe()
    named = os.open(fifo, os.O_RDWR)
    with log.open("ab") as opened:
        for out in (f"/dev/fd/{writer}", fifo, f"/dev/fd/{opened.fileno()}"):
            done = pugeo("upsample", source, "-o", out, "-R", 2, "--format", suffix)
            assert done.status == 0, done.stderr
    clouds = [os.read(reader, 1 << 16), os.read(named, 1 << 16), log.read_bytes()[3:]]
    assert [len(read(io.BytesIO(cloud))) for cloud in clouds] == [600] * 3
    assert log.read_bytes().startswith(b"old")
    assert log.stat().st_ino == inode
    for descriptor in (reader, writer, named):
        os.close(descriptor)
    assert sorted(path.name for path in tmp_path.iterdir()) == [source.name, "fifo", "log"]


def test_existing_outputs(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """An output that exists is refused before the work, skipped, or replaced, as one says."""
    scans = [scan("a.ply"), scan("b.ply")]
    out = tmp_path / "dense"
    out.mkdir()
    (out / "a.ply").write_bytes(b"old")
    refused = pugeo("upsample", *scans, "-o", out, "-R", 2)
    assert refused.status == 2
    assert "--overwrite" in refused.stderr
    assert not (out / "b.ply").exists()
    skipped = pugeo("upsample", *scans, "-o", out, "-R", 2, "--skip-existing")
    assert skipped.status == 0
    assert "1 written, 1 skipped, 0 failed" in skipped.stderr
    assert (out / "a.ply").read_bytes() == b"old"
    replaced = pugeo("upsample", scans[0], "-o", out, "-R", 2, "--overwrite")
    assert replaced.status == 0
    assert len(read(out / "a.ply")) == 600


def test_pipes(pugeo: Run, scan: Run) -> None:
    """A cloud goes from stdin to stdout in its own format, or in another; nothing else is there."""
    data = scan("a.laz").read_bytes()
    same = pugeo("upsample", "-", "-o", "-", "-R", 2, stdin=data)
    assert same.status == 0, same.stderr
    dense = read(io.BytesIO(same.stdout))
    assert dense.source is not None
    assert (len(dense), dense.source.format) == (600, "laz")
    text = pugeo("upsample", "-", "-o", "-", "-R", 2, "--format", "xyz", "-q", stdin=data)
    assert len(read(io.BytesIO(text.stdout), format="xyz")) == 600
    assert text.stderr == ""


def test_a_file_that_is_only_read(pugeo: Run, tmp_path: Path, scan: Run) -> None:
    """The vertices of an OBJ become PLY in a folder, and a note says so."""
    points = read(scan("a.ply")).points.tolist()
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in points)
    (tmp_path / "m.obj").write_text(lines)
    done = pugeo("upsample", tmp_path / "m.obj", "-o", f"{tmp_path}/dense/", "-R", 2)
    assert done.status == 0, done.stderr
    assert "OBJ is only read: the output is PLY by default." in done.stderr
    assert len(read(tmp_path / "dense" / "m.ply")) == 600


def test_attributes_without_room_are_named(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """Attributes that the output format has no room for are named once for all files."""
    scans = [scan("a.ply"), scan("b.ply")]
    arguments = ("-o", f"{tmp_path}/dense/", "-R", 2, "--format", "npy", "--workers", 1)
    done = pugeo("upsample", *scans, *arguments)
    assert done.stderr.count("no room for it: classification. (2 files)") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--jobs"], "give --url"),
        (["--url", "http://localhost:1", "--model", "w.safetensors"], "models by name"),
        (["--url", "http://localhost:1", "--mesh", "m.ply"], "made here"),
        (["--overwrite", "--skip-existing"], "exclude each other"),
        (["--mesh", "m.obj"], "name it .ply"),
        (["--mesh", "none/m.ply"], "does not exist"),
        (["--model", "huge"], "no weights"),
        (["--workers", "0"], "workers"),
        (["-o", "-", "--json"], "both need stdout"),
        (["-R", "4", "--spacing", "1"], "only one of -R, --n-points and --spacing, not -R and"),
        (["-R", "4", "--n-points", "600"], "only one of -R, --n-points and --spacing, not -R and"),
        (["--n-points", "600", "--spacing", "1"], "not --n-points and --spacing"),
        (["--denoise"], "ratio 1"),
        (["--denoise", "-R", "4"], "ratio 1"),
        (["--denoise", "--spacing", "1"], "ratio 1"),
        (["--denoise", "--n-points", "600"], "ratio 1"),
    ],
)
def test_what_does_not_go_together(
    pugeo: Run, scan: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    arguments: list[str], words: str,
) -> None:  # fmt: skip
    """Options that exclude each other are refused before anything is read or written."""
    monkeypatch.chdir(tmp_path)
    done = pugeo("upsample", scan("a.ply"), "-o", "x.ply", *arguments)
    assert done.status == 2
    assert words in " ".join(done.stderr.replace("│", " ").split())
    assert not (tmp_path / "x.ply").exists()


@pytest.mark.parametrize(
    ("arguments", "size"),
    [([], {}), (["-R", "2"], {"ratio": 2.0}), (["--spacing", "1"], {"spacing": 1.0})],
)
def test_a_service_gets_the_size_that_was_given(
    pugeo: Run, scan: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    arguments: list[str], size: dict[str, float],
) -> None:  # fmt: skip
    """A service gets the one size of the command line, and none if the default is meant."""
    asked: list[dict[str, Any]] = []

    class Service:
        error_type = KeyError

        def upsample(self, _source: Path, target: Path, _format: str, options: Any, _: Any) -> Any:
            asked.append(options)
            target.touch()
            return {"points_in": 1, "points_out": 1, "dropped": {}, "notes": []}

        def each(self, call: Any, items: Any, _concurrency: int) -> Any:
            return map(call, items)

        def close(self) -> None:
            closed.append(True)

    closed: list[bool] = []
    monkeypatch.setattr("pugeo_model.cli.remote.connect", lambda *_, **__: Service())
    out = tmp_path / "x.ply"
    done = pugeo("upsample", scan("a.ply"), "-o", out, "--url", "http://there", *arguments)
    assert done.status == 0, done.stderr
    assert closed == [True]
    sizes = {name: asked[0].get(name) for name in ("ratio", "n_points", "spacing")}
    assert {name: value for name, value in sizes.items() if value is not None} == size


def test_help_is_short_to_ask_for(pugeo: Run) -> None:
    """-h is --help, of the program and of each command."""
    for arguments in ((), ("upsample",), ("info",)):
        assert b"Usage: " in pugeo(*arguments, "-h").stdout


@pytest.mark.slow
def test_twelve_tiles_with_one_broken(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """Two processes write eleven of twelve LAZ tiles; summary and status tell of the twelfth."""
    tiles = [scan(f"tiles/{number:02d}.laz") for number in range(12)]
    tiles[5].write_bytes(tiles[5].read_bytes()[:300])
    out = tmp_path / "dense"
    done = pugeo("upsample", tmp_path / "tiles", "-o", out, "-R", 2, "--workers", 2)
    assert done.status == 3
    assert f"error: {tiles[5]} (laz): " in done.stderr
    assert "11 written, 0 skipped, 1 failed: 6,600 points" in done.stderr
    written = sorted(out.iterdir())
    assert [path.name for path in written] == [t.name for t in tiles if t != tiles[5]]
    assert all(len(read(path)) == 600 for path in written)
    alone = io.BytesIO()
    assert pugeo("upsample", tiles[0], "-o", tmp_path / "alone.laz", "-R", 2).status == 0
    write(read(tmp_path / "alone.laz"), alone, format="xyz")
    together = io.BytesIO()
    write(read(written[0]), together, format="xyz")
    assert alone.getvalue() == together.getvalue()
