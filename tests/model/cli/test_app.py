# SPDX-License-Identifier: Apache-2.0
"""The command as installed, in a process of its own where that is what is tested."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pugeo_model
from pugeo_model import Cloud
from pugeo_model.formats import read, write

PUGEO = str(Path(sys.executable).parent / "pugeo")


def run(*args: object):
    return subprocess.run([PUGEO, *map(str, args)], capture_output=True, text=True, check=False)


@pytest.fixture
def ball(tmp_path):
    """A PLY file of 500 points of a sphere, one of them twice."""
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    write(Cloud(np.concatenate([points, points[:1]])), tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.mark.slow
def test_upsample_writes_by_suffix(ball, tmp_path, pugeo):
    """The suffix of the output is its format; counts and dropped points are printed."""
    done = run("upsample", ball, "-R", "3", "-o", tmp_path / "dense.ply")
    here = pugeo("upsample", ball, "-R", "3", "-o", tmp_path / "dense.npz")
    for status, printed in ((done.returncode, done.stderr), (here.status, here.stderr)):
        assert status == 0, printed
        assert "1,500 points" in printed
        assert "1 duplicate" in printed
    for name in ("dense.ply", "dense.npz"):
        dense = read(tmp_path / name)
        assert len(dense) == 1500
        assert dense.normals is not None


def test_a_format_without_room_for_normals(ball, tmp_path, pugeo):
    """Attributes that the output format cannot hold are named in a note."""
    done = pugeo("upsample", ball, "-R", "2", "-o", tmp_path / "dense.ptx")
    assert done.status == 0, done.stderr
    assert "no room for it: normals" in " ".join(done.stderr.split())


def test_a_format_that_is_only_read(ball, tmp_path, pugeo):
    """An output format that cannot be written is refused, with those that can be."""
    done = pugeo("upsample", ball, "-o", tmp_path / "dense.obj")
    assert done.status == 2
    assert "ply" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["-R", "99"], "from 1 to 32"),
        (["--orient", "up"], "one of"),
        (["--viewpoint", "1,2"], "three numbers"),
        (["--model", "huge"], "no weights"),
    ],
)
def test_bad_options_are_one_line(ball, tmp_path, pugeo, args, words):
    """A bad option gives a message and exit status 2, and leaves no file."""
    done = pugeo("upsample", ball, "-o", tmp_path / "dense.ply", *args)
    assert done.status == 2
    assert words in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "dense.ply").exists()


def test_bad_files_are_one_line(tmp_path, pugeo):
    """Missing, empty and truncated files give a message, not a traceback."""
    (tmp_path / "empty.ply").write_bytes(b"")
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
    (tmp_path / "cut.ply").write_bytes(header + b"property float y\nproperty float z\nend_header\n")
    for name in ("missing.ply", "empty.ply", "cut.ply"):
        done = pugeo("upsample", tmp_path / name, "-o", tmp_path / "dense.ply")
        assert done.status == 2, name
        assert "error:" in done.stderr
        assert "Traceback" not in done.stderr


def test_a_bad_option_and_a_bad_file_of_the_installed_command(tmp_path):
    """Each gives a message and exit status 2, not a traceback."""
    (tmp_path / "empty.ply").write_bytes(b"")
    for words in (["-R", "99"], []):
        done = run("upsample", tmp_path / "empty.ply", "-o", tmp_path / "dense.ply", *words)
        assert done.returncode == 2
        assert ("from 1 to 32" if words else "error:") in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr


def test_models_and_version():
    """The released weights and the version are listed."""
    assert "standard" in run("models").stdout
    assert run("--version").stdout.strip() == pugeo_model.__version__
