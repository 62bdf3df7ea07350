# SPDX-License-Identifier: Apache-2.0
"""Files, folders and patterns of the command line."""

from pathlib import Path

import pytest

from pugeo_model.cli.inputs import expand, format_of


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with scans in two folders and files of other kinds."""
    names = ("a.ply", "b.LAZ", "sub/c.xyz", "notes.md", ".hidden.ply", "out/a.ply", "[1].ply")
    for name in names:
        (tmp_path / "scans" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "scans" / name).write_bytes(b"ply\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def paths(*arguments: str, beside: Path | None = None) -> list[str]:
    return [
        "-" if each.path is None else each.path.as_posix()
        for each in expand(map(Path, arguments), beside)
    ]


@pytest.mark.usefixtures("folder")
def test_a_folder() -> None:
    """A folder stands for its clouds, those in its folders too, but not for those of the output."""
    found = ["scans/[1].ply", "scans/a.ply", "scans/b.LAZ", "scans/sub/c.xyz"]
    assert paths("scans", beside=Path("scans/out")) == found
    assert "scans/out/a.ply" in paths("scans")
    assert [each.folder.as_posix() for each in expand([Path("scans")], Path("scans/out"))] == [
        *(".", ".", "."),
        "sub",
    ]


@pytest.mark.usefixtures("folder")
def test_patterns() -> None:
    """Patterns are matched where no shell does; ** is any folders; a file's own name is first."""
    assert paths("scans/*.ply") == ["scans/[1].ply", "scans/a.ply"]
    assert paths("scans/**/*.xyz") == ["scans/sub/c.xyz"]
    assert paths("scans/[1].ply") == ["scans/[1].ply"]


@pytest.mark.usefixtures("folder")
def test_each_file_once() -> None:
    """A file that is named twice is one input; the order is that of the arguments."""
    assert paths("scans/b.LAZ", "-", "scans/*", "scans/a.ply")[:2] == ["scans/b.LAZ", "-"]
    found = paths("scans/a.ply", "scans/*.ply", "scans/a.ply")
    assert found == ["scans/a.ply", "scans/[1].ply"]


@pytest.mark.usefixtures("folder")
def test_nothing_found() -> None:
    """A pattern without a match and a folder without a cloud are errors that name them."""
    with pytest.raises(FileNotFoundError, match=r"no file matches scans/\*\.las"):
        expand([Path("scans/*.las")])
    Path("empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"folder empty has .* \.laz"):
        expand([Path("empty")])


def test_formats(tmp_path: Path) -> None:
    """The format is that of the content; without one the reason is told, and nothing is raised."""
    (tmp_path / "wrong.laz").write_bytes(b"ply\nformat ascii 1.0\n")
    (tmp_path / "empty.ply").touch()
    (tmp_path / "what.bin").write_bytes(b"\0\1\2")
    assert format_of(tmp_path / "wrong.laz") == ("ply-ascii", None)
    for name, words in (("empty", "is empty"), ("what", "no known format"), ("none", "No such")):
        path = next(iter(tmp_path.glob(f"{name}.*")), tmp_path / name)
        found, reason = format_of(path)
        assert found is None
        assert words in str(reason)
