# SPDX-License-Identifier: Apache-2.0
"""Faults of the machine and of the weights are told in one line before anything starts."""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pugeo_model import weights
from pugeo_service import preflight
from pugeo_service.settings import Settings


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A copy of released weights with their card."""
    for suffix in (".safetensors", ".json"):
        shutil.copy(weights.locate("fast").with_suffix(suffix), tmp_path / f"own{suffix}")
    return tmp_path / "own.safetensors"


def change_card(path: Path, change: dict[str, Any]) -> None:
    """Replace members of a card; ``None`` removes one."""
    card = json.loads(path.with_suffix(".json").read_text()) | change
    kept = {name: value for name, value in card.items() if value is not None}
    path.with_suffix(".json").write_text(json.dumps(kept))


def told(model: object) -> str:
    """The line about weights that cannot be used."""
    line = preflight.unfit_weights(Settings(model=str(model)))
    assert line is not None
    assert line.startswith(f"PUGEO_MODEL={model}: ")
    assert "\n" not in line
    return line


def test_released_weights_state_their_sha256() -> None:
    """The cards of all released weights have the sha256 of their files."""
    for name in weights.available():
        path = weights.locate(name).with_suffix(".json")
        assert json.loads(path.read_text())["sha256"] == weights.read_card(name)["sha256"]
        assert preflight.unfit_weights(Settings(model=name)) is None


def test_no_such_weights() -> None:
    """Unknown names are refused with the known ones."""
    assert "give one of fast, scans, standard" in told("huge")


def test_damaged_weights_are_not_served(own: Path) -> None:
    """Weights with other bytes than their card states are refused."""
    data = bytearray(own.read_bytes())
    data[-100_000:] = b"\xff" * 100_000
    own.write_bytes(data)
    assert "damaged or belongs to another card" in told(own)


@pytest.mark.parametrize("content", [None, "", "[]", "{}"])
def test_weights_without_a_card(own: Path, content: str | None) -> None:
    """A card that is missing, empty, no object or incomplete is named."""
    card = own.with_suffix(".json")
    card.unlink() if content is None else card.write_text(content)
    assert "card own.json" in told(own)


def test_a_card_has_a_version(own: Path) -> None:
    """Answers name the version of the weights, so the card must."""
    change_card(own, {"version": None})
    assert "has no version" in told(own)


def test_weights_that_do_not_load(own: Path) -> None:
    """Without a sha256 in the card, weights that are cut or of another network are refused too."""
    change_card(own, {"sha256": None})
    assert preflight.unfit_weights(Settings(model=str(own))) is None
    other = json.loads(weights.locate("standard").with_suffix(".json").read_text())
    change_card(own, {"architecture": other["architecture"]})
    assert "not of the network of their card" in told(own)
    own.write_bytes(own.read_bytes()[:-1000])
    assert "the file is damaged" in told(own)


def test_a_machine_without_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without /dev/shm no worker process can start; it is told how to get one."""
    assert preflight.unfit_machine(Settings()) is None

    def refuse(_: object) -> None:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(multiprocessing.get_context("spawn").__class__, "Lock", refuse)
    line = preflight.unfit_machine(Settings())
    assert line is not None
    assert "writable /dev/shm" in line
    assert preflight.unfit_machine(Settings(engine="inline")) is None


def test_a_machine_without_proc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without /proc workers cannot be watched."""
    monkeypatch.setattr(preflight, "_PROC", tmp_path / "missing")
    monkeypatch.setattr(sys, "platform", "linux")
    assert (preflight.unfit_machine(Settings()) or "").startswith("/proc is not mounted")


def test_a_wrong_setting_ends_with_one_line(tmp_path: Path) -> None:
    """The process ends with status 2 and one line on stderr, before anything starts."""
    environment = {**os.environ, "PUGEO_WORKER_MEMORY": "abc", "PUGEO_SPOOL_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pugeo_service"]
    done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[1:] == []
    assert done.stderr.startswith("PUGEO_WORKER_MEMORY=abc: must be auto")
    assert list(tmp_path.iterdir()) == []


HIDE = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hide())
sys.argv = ["pugeo", *{arguments!r}]
from pugeo_model.cli import main
main()
"""


@pytest.mark.parametrize(
    ("arguments", "hidden", "extra"),
    [
        (["serve"], ["fastapi", "uvicorn", "structlog", "distributed"], "server"),
        (["keys", "new", "ann"], ["structlog"], "server"),
        (["train", "folder", "-o", "out"], ["igl", "matplotlib"], "train"),
    ],
)
def test_commands_without_their_extra(arguments: list[str], hidden: list[str], extra: str) -> None:
    """A command whose packages are missing says which extra to install, without a traceback."""
    code = HIDE.format(hidden=set(hidden), arguments=arguments)
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"pip install 'pugeo[{extra}]" in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr
