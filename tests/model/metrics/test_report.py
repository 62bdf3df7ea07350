# SPDX-License-Identifier: Apache-2.0
import json
import shutil
import sys
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")
pytest.importorskip("matplotlib", reason="the report needs the evaluate extra")

import igl

from pugeo_model.cli import app
from pugeo_model.cloud import Cloud
from pugeo_model.formats import write
from pugeo_model.mesh.sampling import poisson_disk
from pugeo_model.metrics.evaluation import COLUMNS, Case, Truth
from pugeo_model.metrics.pictures import draw
from pugeo_model.metrics.report import evaluate_all
from pugeo_model.metrics.tables import table
from pugeo_model.weights import locate

CASES = [Case("300", 2, 600), Case("300", 4, 1200)]


@pytest.fixture
def shapes(ball, tmp_path):
    """A folder of one mesh and one of its samples."""
    truth = Truth(ball)
    for folder in ("meshes", "samples/inputs", "samples/gt"):
        (tmp_path / folder).mkdir(parents=True)
    igl.write_triangle_mesh(str(tmp_path / "meshes/ball.ply"), truth.vertices, truth.faces)
    for place, count in (("inputs", 300), ("gt", 600), ("gt", 1200)):
        points = poisson_disk(truth.vertices, truth.faces, count, np.random.default_rng(count))
        write(Cloud(points), tmp_path / f"samples/{place}/ball_{count}.ply")
    return tmp_path / "meshes", tmp_path / "samples"


@pytest.fixture
def weights(tmp_path):
    """A copy of the released weights, with a card that may be changed."""
    released = locate("standard")
    for path in (released, released.with_suffix(".json")):
        shutil.copy(path, tmp_path / f"copy{path.suffix}")
    return tmp_path / "copy.safetensors"


def test_everything_at_once(shapes, weights, tmp_path, monkeypatch):
    """JSON, report, picture and card of all methods and cases agree; progress is complete."""
    monkeypatch.setattr("pugeo_model.metrics.pictures.draw", partial(draw, pixels=100))
    ticks = []
    text = evaluate_all(
        str(weights),
        *shapes,
        cases=CASES,
        compare=True,
        out=tmp_path / "out.json",
        report=tmp_path / "new/report",
        card=True,
        tick=lambda *call: ticks.append(call),
    )
    names = ["ours", "plane", "jet", *(["poisson"] if find_spec("pycolmap") else []), "limit"]
    figures = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert [list(sources) for sources in figures["means"].values()] == [names, names]
    assert [call[1:] for call in ticks] == [(n + 1, 2 * len(names)) for n in range(2 * len(names))]
    for sources in figures["means"].values():
        assert set(sources["ours"]) == {*COLUMNS[: COLUMNS.index("CD#")], "seconds"}
        assert sources["limit"]["P2F"] < 1e-3 < sources["ours"]["P2F"] < sources["plane"]["P2F"]
    assert (tmp_path / "new/report/figures.json").read_text() == (tmp_path / "out.json").read_text()
    report = (tmp_path / "new/report/report.md").read_text("utf-8")
    assert text in report
    for name in names:
        assert f"| ball | {name} |" in report
    assert "(pictures/ball.png)" in report
    assert (tmp_path / "new/report/pictures/ball.png").read_bytes()[:4] == b"\x89PNG"
    quality = json.loads(weights.with_suffix(".json").read_text("utf-8"))["quality"]
    assert set(quality) == {case.name for case in CASES}
    for case, means in figures["means"].items():
        assert quality[case]["CD"] == pytest.approx(means["ours"]["CD"], abs=1e-4)


def test_reconstructed_surfaces_have_columns(shapes, monkeypatch):
    """On a smooth ball the surfaces from the model and from the limit are equally accurate."""
    pytest.importorskip("pycolmap", reason="reconstruction needs the evaluate extra")
    monkeypatch.setattr("pugeo_model.metrics.evaluation._SURFACE_SAMPLES", 20_000)
    text = evaluate_all("standard", *shapes, cases=CASES[1:], surfaces=True)
    head, _, ours, limit = (line.strip("| ").split(" | ") for line in text.splitlines())
    where = head.index("CD#")
    floor = 100 * 0.5 * np.sqrt(np.pi / 20_000)  # of two samples of one surface of this area
    assert 0.97 * floor < float(limit[where]) < 1.05 * floor
    assert 0.97 * floor < float(ours[where]) < 1.1 * floor


def test_tables_omit_empty_columns():
    """Empty columns are omitted, missing values are blank, values are rounded."""
    text = table([(("a",), {"CD": 0.12345, "P2F": 2.0}), (("b",), {"CD": 1.0})], ("shape",))
    assert text.splitlines() == [
        "| shape | CD | P2F |",
        "| --- | ---: | ---: |",
        "| a | 0.1235 | 2.000 |",
        "| b | 1.0000 |  |",
    ]


@pytest.mark.parametrize(
    ("gone", "flags"),
    [("pycolmap", ["--reconstruct"]), ("matplotlib", ["--report", "new"])],
)
def test_a_missing_library_is_named_at_once(gone, flags, tmp_path, monkeypatch):
    """A missing library is an error before the evaluation; it names the library and the extra."""
    monkeypatch.setitem(sys.modules, gone, None)
    done = CliRunner().invoke(
        app, ["evaluate", "--meshes", str(tmp_path), "--samples", str(tmp_path), *flags]
    )
    assert done.exit_code == 2
    assert f"needs {gone}" in " ".join(done.output.split())
    assert "pugeo[evaluate]" in done.output


def test_unknown_cases_and_empty_folders(tmp_path):
    """An unknown case and a folder without meshes are errors that name them."""
    folders = ["--meshes", str(tmp_path), "--samples", str(tmp_path)]
    done = CliRunner().invoke(app, ["evaluate", *folders, "--case", "7 x7"])
    assert done.exit_code == 2
    assert "5000 x16" in " ".join(done.output.split())
    done = CliRunner().invoke(app, ["evaluate", *folders])
    assert isinstance(done.exception, FileNotFoundError)
    assert "no NAME.ply" in str(done.exception)
