# SPDX-License-Identifier: Apache-2.0
"""Networks of the tables are trained one after the other, and a stopped run goes on later."""

from unittest.mock import Mock

import pytest

pytest.importorskip("igl", reason="training needs the train extra")

from typer.testing import CliRunner

from pugeo_model.cli import app
from pugeo_model.reproduce.trained import Trained, train_missing
from pugeo_model.training import run as training

WANTED = [Trained("paper", 4), Trained("pu_net", 4), Trained("mpu", 4)]


@pytest.fixture
def run(monkeypatch):
    """Takes the place of a training, which comes to its end."""
    monkeypatch.setattr(training, "load_shapes", lambda _folder: [])
    replaced = Mock(return_value=True)
    monkeypatch.setattr(training, "run", replaced)
    return replaced


def folders(run):
    """Folders of the runs that were begun, in their order."""
    return [call.args[4].name for call in run.call_args_list]


def test_all_are_trained(run, tmp_path):
    """In their order, each in a folder of its name."""
    assert train_missing(tmp_path, tmp_path, tmp_path, WANTED, 1, lambda *_: None)
    assert folders(run) == ["paper_x4", "pu_net_x4", "mpu_x4"]


def test_a_stopped_run_is_the_last(run, tmp_path):
    """After SIGTERM no other network is begun, and the command says how to go on."""
    run.side_effect = [True, False]
    assert not train_missing(tmp_path, tmp_path, tmp_path, WANTED, 1, lambda *_: None)
    assert folders(run) == ["paper_x4", "pu_net_x4"]
    run.side_effect = [False]
    folder = str(tmp_path)
    arguments = ["reproduce", "--meshes", folder, "--samples", folder, "--train-on", folder]
    ended = CliRunner().invoke(app, [*arguments, "--networks", folder, "--steps", "1"])
    assert ended.exit_code == 143
    assert "the same command goes on from there" in " ".join(ended.output.split())
