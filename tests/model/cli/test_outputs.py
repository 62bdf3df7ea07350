# SPDX-License-Identifier: Apache-2.0
"""Outputs of the command line: their names, formats and checks, all before the work."""

import os
from pathlib import Path

import pytest

from pugeo_model.cli.inputs import Found
from pugeo_model.cli.outputs import check_replaced, folder_of, make_tasks
from pugeo_model.cli.tasks import CommandError

HEADS = {"ply": b"ply\nformat binary_little_endian 1.0\n", "laz": b"LASF" + bytes(100),
         "obj": b"v 0 0 0\n", "ascii": b"ply\nformat ascii 1.0\n"}  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def make(name: str, head: bytes = HEADS["ply"]) -> Found:
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head)
    return Found(path)


@pytest.mark.parametrize(
    ("out", "arguments", "folder"),
    [
        ("dense.ply", ["a.ply"], None),
        ("dense/", ["a.ply"], "dense"),
        ("dense", ["a.ply", "b.ply"], "dense"),
        ("dense", ["*.ply"], "dense"),
        ("dense", ["scan?.ply"], "dense"),
        ("dense", ["tiles/*/a.ply"], "dense"),
        ("dense.ply", ["[1].ply"], None),
        ("there", ["a.ply"], "there"),
        ("-", ["a.ply"], None),
    ],
)
@pytest.mark.usefixtures("here")
def test_folders(out: str, arguments: list[str], folder: str | None) -> None:
    """An output is a folder if it ends with a slash, is one, or has several inputs."""
    Path("there").mkdir()
    Path("[1].ply").touch()
    found = folder_of(out, [Path(each) for each in arguments])
    assert found == (None if folder is None else Path(folder))


@pytest.mark.parametrize("out", ["-", "dense.ply", "file"])
@pytest.mark.usefixtures("here")
def test_several_inputs_and_one_file(out: str) -> None:
    """Several inputs do not fit into a file or standard output."""
    Path("file").touch()
    with pytest.raises(CommandError, match="folder"):
        folder_of(out, [Path("a.ply"), Path("b.ply")])


@pytest.mark.parametrize(
    ("name", "head", "format", "target"),
    [
        ("a.PLY", "ply", None, ("a.PLY", "ply")),
        ("a.ply", "ascii", None, ("a.ply", "ply-ascii")),
        ("a.txt", "ply", None, ("a.ply", "ply")),
        ("a.obj", "obj", None, ("a.ply", "ply")),
        ("a.ply", "ply", "laz", ("a.laz", "laz")),
        ("a.b.ply", "ply", "xyz", ("a.b.xyz", "xyz")),
        ("a.csv", "ply", "xyz", ("a.csv", "xyz")),
    ],
)
@pytest.mark.usefixtures("here")
def test_names_and_formats(
    name: str, head: str, format: str | None, target: tuple[str, str]
) -> None:
    """An output keeps the name of its input, and the extension where it belongs to the format."""
    (task,) = make_tasks([make(name, HEADS[head])], "dense/", Path("dense"), format)
    assert (task.target, task.format) == (Path("dense", target[0]), target[1])
    assert Path("dense").is_dir()


@pytest.mark.usefixtures("here")
def test_the_format_of_a_file() -> None:
    """The suffix of an output file decides; without one it has the format of the input."""
    found = [make("a.ply", HEADS["ascii"])]
    formats = {out: make_tasks(found, out, None, None)[0].format for out in ("x.laz", "x", "-")}
    assert formats == {"x.laz": "laz", "x": "ply-ascii", "-": "ply-ascii"}
    assert make_tasks([Found(None)], "-", None, None)[0].format is None


@pytest.mark.usefixtures("here")
def test_folders_are_kept() -> None:
    """Folders within a folder of inputs are made in the output."""
    found = [Found(make(f"scans/{each}/a.ply").path, Path(each)) for each in ("x", "y/z")]
    tasks = make_tasks(found, "dense", Path("dense"), None)
    assert [task.target for task in tasks] == [Path("dense/x/a.ply"), Path("dense/y/z/a.ply")]
    assert Path("dense/y/z").is_dir()


@pytest.mark.usefixtures("here")
def test_a_broken_input_is_a_task_with_its_reason() -> None:
    """An input of no known format does not end the run."""
    good, bad = make_tasks([make("a.ply"), make("b.ply", b"")], "d", Path("d"), None)
    assert good.error is None
    assert bad.error == "The file is empty."


@pytest.mark.parametrize(
    ("names", "out", "format", "words"),
    [
        (["a.ply"], "x.obj", None, "has the extension of 'x.obj'"),
        (["a.ply"], "x.docx", None, "Or say --format"),
        (["a.ply"], "x.ply", "obj", "--format obj cannot be written: give one of"),
        (["a.ply"], "missing/x.ply", None, "folder missing .* does not exist"),
        (["a.ply"], "a.ply", None, "would replace an input"),
        (["a.ply"], "sub/../a.ply", None, "would replace an input"),
        (["a.ply"], "sub", None, "is a folder: write -o sub/"),
    ],
)
@pytest.mark.usefixtures("here")
def test_refused(names: list[str], out: str, format: str | None, words: str) -> None:
    """An output that cannot be written is refused with its name and the way out."""
    Path("sub").mkdir()
    found = [make(name) for name in names]
    with pytest.raises(CommandError, match=words):
        make_tasks(found, out, None, format)


@pytest.mark.usefixtures("here")
def test_two_inputs_of_one_name() -> None:
    """Two inputs that would become one file are refused by both names; case does not matter."""
    with pytest.raises(CommandError, match=r"x/a\.ply and y/A\.ply would both"):
        make_tasks([make("x/a.ply"), make("y/A.ply")], "d", Path("d"), None)


@pytest.mark.usefixtures("here")
def test_standard_input_in_a_folder() -> None:
    """Standard input has no name for a file in a folder."""
    with pytest.raises(CommandError, match="give -o a file"):
        make_tasks([Found(None)], "d/", Path("d"), None)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write all")
@pytest.mark.usefixtures("here")
def test_no_permission() -> None:
    """An output in a folder that cannot be written is refused."""
    Path("locked").mkdir(mode=0o500)
    with pytest.raises(CommandError, match="no permission"):
        make_tasks([make("a.ply")], "locked/x.ply", None, None)


@pytest.mark.usefixtures("here")
def test_existing_outputs() -> None:
    """Existing outputs are refused with both ways out; devices are no files to be replaced."""
    found = [make("a.ply"), make("b.ply")]
    tasks = make_tasks(found, "d", Path("d"), None)
    check_replaced(tasks)
    for name in ("a.ply", "b.ply"):
        Path("d", name).touch()
    with pytest.raises(CommandError, match=r"d/a\.ply and 1 more .*--overwrite .*--skip-existing"):
        check_replaced(tasks)
    check_replaced(make_tasks([make("a.ply")], os.devnull, None, None))
