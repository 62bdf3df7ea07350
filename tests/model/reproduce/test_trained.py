# SPDX-License-Identifier: Apache-2.0
"""Networks of the tables are trained one after the other, and a stopped run goes on later."""

import pytest

pytest.importorskip("igl", reason="training needs the train extra")

from typer.testing import CliRunner

from pugeo_model.cli import app
from pugeo_model.reproduce.trained import Trained, train_missing
from pugeo_model.training import run as training


@pytest.fixture
def runs(monkeypatch):
    """Names of the runs that were begun; each comes to its end unless the list says otherwise."""
    begun: list[str] = []
    ends: dict[str, bool] = {}

    def run(_1, _2, _3, _recipe, _folder, name, _recipe_name, every, tick):  # noqa: ARG001
        begun.append(name)
        return ends.get(name, True)

    monkeypatch.setattr(training, "load_shapes", lambda _folder: [])
    monkeypatch.setattr(training, "run", run)
    return begun, ends


WANTED = [Trained("paper", 4), Trained("pu_net", 4), Trained("mpu", 4)]


def test_all_are_trained(runs, tmp_path):
    """In their order, each in a folder of its name."""
    begun, _ = runs
    assert train_missing(tmp_path, tmp_path, tmp_path, WANTED, 1, lambda *_: None)
    assert begun == ["paper_x4", "pu_net_x4", "mpu_x4"]


def test_a_stopped_run_is_the_last(runs, tmp_path):
    """After SIGTERM no other network is begun, and the command says how to go on."""
    begun, ends = runs
    ends["pu_net_x4"] = False
    assert not train_missing(tmp_path, tmp_path, tmp_path, WANTED, 1, lambda *_: None)
    assert begun == ["paper_x4", "pu_net_x4"]
    folder = str(tmp_path)
    arguments = ["reproduce", "--meshes", folder, "--samples", folder, "--train-on", folder]
    ended = CliRunner().invoke(app, [*arguments, "--networks", folder, "--steps", "1"])
    assert ended.exit_code == 143
    assert "the same command goes on from there" in " ".join(ended.output.split())
