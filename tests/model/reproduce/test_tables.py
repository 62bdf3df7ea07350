# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")
pytest.importorskip("matplotlib", reason="figures need the evaluate extra")

import igl

from pugeo_model.cli import app
from pugeo_model.cloud import Cloud
from pugeo_model.formats import read, write
from pugeo_model.metrics.evaluation import Truth, reference
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture
from pugeo_model.reproduce import printed, rows, tables
from pugeo_model.reproduce.budget import draw_curves, full_schedule
from pugeo_model.reproduce.document import lines_table, section
from pugeo_model.reproduce.robustness import draw, few_points, lidar, noisy_points
from pugeo_model.reproduce.rows import RowStore, Setting
from pugeo_model.reproduce.solids import sphere
from pugeo_model.reproduce.stored import stored, stored_path
from pugeo_model.reproduce.trained import ABLATIONS, RATIOS, Trained, megabytes, needed
from pugeo_model.training.recipes import available_recipes
from pugeo_model.weights import read_card, save

TINY = (("k", 8), ("width", 8), ("fused", 16))


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A ball with a sample of 1,000 points, in the place of 5,000: mesh, folder of samples."""
    folder = tmp_path_factory.mktemp("truth")
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 33), np.linspace(0, 2 * np.pi, 65)[:-1])
    grid = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    row, column = np.mgrid[:64, :32]
    a, b = 33 * row + column, 33 * ((row + 1) % 64) + column
    faces = np.concatenate([np.stack([a, b, a + 1], -1), np.stack([b, b + 1, a + 1], -1)])
    (folder / "meshes").mkdir()
    (folder / "inputs").mkdir()
    mesh = folder / "meshes/ball.ply"
    igl.write_triangle_mesh(str(mesh), 0.5 * grid.reshape(-1, 3), faces.reshape(-1, 3))
    write(Cloud(sphere(1000).points.astype(np.float32)), folder / "inputs/ball_1000.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "_POINTS", 1000)
        yield Truth(mesh), folder


@pytest.fixture
def networks(tmp_path):
    """A folder of runs with tiny networks in the place of trained ones."""
    torch.manual_seed(0)
    for name, backbone, ratio in (("paper_x4", "pugeo-net", 4), ("pu_net_x4", "pu-net", 4)):
        options = {"ratio": ratio, **(dict(TINY) if backbone == "pugeo-net" else {})}
        net = build_network(Architecture(backbone, 16, tuple(options.items()), 8))
        card = {
            "name": name,
            "parameters": sum(p.numel() for p in net.parameters()),
            "training": {"steps": 7, "hours": 0.01, "command": "pugeo train", "hardware": "a CPU"},
        }
        save(net, card, tmp_path / name / f"{name}.safetensors")
    return tmp_path


def twice(cloud, ratio):
    """Every point ``ratio`` times, a little apart, with its true normal."""
    rng = np.random.default_rng(0)
    points = np.repeat(cloud.points.astype(float), int(ratio), axis=0)
    points += rng.normal(0, 1e-3, points.shape)
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    return Cloud(points, normals=unit.astype(np.float32))


def test_all_networks_of_the_tables():
    """Three methods at four R but MPU at 12, PU-Net-M, five ablations of both networks, ours."""
    names = [each.name for each in needed()]
    assert len(names) == len(set(names)) == 3 * 4 - 1 + 1 + 5 + 5 + 1
    assert "mpu_x12" not in names
    assert {each.recipe for each in needed()} <= set(available_recipes())
    assert Trained("mpu", 12).impossible()
    assert "--ratio 8" in Trained("paper", 8).command(runs := Path("runs"))
    assert Trained("paper", 8).weights(runs).as_posix() == "runs/paper_x8/paper_x8.safetensors"


def test_printed_tables_are_whole():
    """Every line of the paper's tables has all its columns."""
    assert {key[1] for key in printed.COMPARISON} == set(RATIOS)
    assert {len(row) for row in printed.COMPARISON.values()} == {8}
    assert set(printed.ABLATION) == {*ABLATIONS, "paper"}
    assert {len(row) for row in printed.NORMALS.values()} == {3}
    assert set(printed.SIZES_MB) <= set(printed.COMPARISON)


def test_rows_are_kept(truth, tmp_path):
    """A known key is not measured again, unless it is asked for anew; another key is."""
    shape, samples = truth
    setting = Setting([shape], samples, surfaces=False)
    asked = []

    def method(cloud, ratio):
        asked.append(ratio)
        return twice(cloud, ratio)

    first = RowStore(tmp_path / "rows.json", setting).row("twice x2", method, 2)
    assert 0 < first.columns["P2F"] < 3.0
    assert first.columns["normal_mean"] < 3.0
    assert first.spent >= first.seconds > 0
    store = RowStore(tmp_path / "rows.json", setting)
    assert store.row("twice x2", method, 2) == first
    assert asked == [2]
    store.row("twice x3", method, 3)
    assert asked == [2, 3]
    anew = RowStore(tmp_path / "rows.json", setting, anew=True)
    anew.row("twice x2", method, 2)
    anew.row("twice x2", method, 2)
    assert asked == [2, 3, 2]
    assert set(json.loads((tmp_path / "rows.json").read_text())) == {"twice x2", "twice x3"}


def test_references(truth, tmp_path):
    """The stored sample where there is one, else one that is the same every time."""
    shape, samples = truth
    made = reference(shape, samples, 400)
    np.testing.assert_array_equal(made, reference(shape, samples, 400))
    (tmp_path / "gt").mkdir()
    write(Cloud(made[:300].astype(np.float32)), tmp_path / "gt/ball_400.ply")
    assert len(reference(shape, tmp_path, 400)) == 300


@pytest.mark.slow
def test_the_comparison(truth, networks, tmp_path, monkeypatch):
    """Trained networks are measured; for others, and for what cannot be, it says why."""
    shape, samples = truth
    monkeypatch.setattr(tables, "RATIOS", (4, 12))
    store = RowStore(tmp_path / "rows.json", Setting([shape], samples, surfaces=False))
    lines = {(line.method, line.ratio): line for line in tables.comparison(store, networks, "fast")}
    paper = lines["PUGeo-Net as published", 4]
    assert paper.row is not None
    assert paper.printed == printed.COMPARISON["paper", 4]
    assert paper.printed_megabytes == 26.6
    card = read_card(networks / "paper_x4/paper_x4.safetensors")
    assert paper.megabytes == megabytes(card) == card["parameters"] * 12 / 1e6
    assert "7 steps" in paper.budget
    assert "powers of 2" in lines["MPU", 12].why
    assert "pugeo train" in lines["PU-Net", 12].why
    assert "benchmarks.ear" in lines["EAR", 4].why
    ours = [line for name, line in lines.items() if "ours" in name[0]]
    assert len(ours) == 2
    assert all(line.row is not None for line in ours)
    text = lines_table(lines.values())
    assert "(0.558)" in text
    assert "- MPU, R=12: a cascade" in text


@pytest.mark.slow
def test_normals_are_compared_at_the_same_points(truth, networks, tmp_path):
    """One run of the network serves its own normals and five PCAs, each with its number."""
    shape, samples = truth
    store = RowStore(tmp_path / "rows.json", Setting([shape], samples, surfaces=False))
    lines = list(tables.normals(store, networks, "fast", ratio=4))
    found = [line.row for line in lines if line.row is not None]
    # Ours and the tiny network of the paper; PU-Net-M is not there.
    assert len(found) == 2 * 6
    assert len({row.columns["CD"] for row in found[:6]}) == 1
    assert len({row.columns["normal_mean"] for row in found[:6]}) == 6
    assert [line.printed for line in lines[:5]] == [
        printed.NORMALS[f"PCA-{count}"] for count in tables.PCA_COUNTS
    ]
    assert "pu_net_m" in lines[-1].why


def test_curves_and_the_papers_schedule(tmp_path):
    """A picture from logs, with and without normals; 240,000 steps at the measured speed."""
    full, bare = tmp_path / "full.csv", tmp_path / "bare.csv"
    full.write_text("step,val_chamfer,val_refined_normal,hours\n250,.06,.2,.1\n500,.05,.1,.2\n")
    bare.write_text("step,val_chamfer,hours\n250,.07,.1\n500,.06,.2\n")
    draw_curves({"full": full, "bare": bare}, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5000
    training = {"steps": 1000, "hours": 0.25, "hardware": "1 thread(s) of a CPU"}
    assert "would take 60 h" in full_schedule({"training": training})


def test_clouds_of_another_program(truth, tmp_path):
    """They are found by their input; another input has none, and its row no seconds."""
    shape, samples = truth
    cloud = read(samples / "inputs/ball_1000.ply")
    folder = tmp_path / "ear_x4"
    folder.mkdir()
    write(twice(cloud, 4), stored_path(folder, cloud), format="ply")
    store = RowStore(tmp_path / "rows.json", Setting([shape], samples, surfaces=False))
    line = next(tables.comparison(store, tmp_path, "fast"))
    assert line.method == "EAR"
    assert line.row is not None
    assert line.row.columns["normal_mean"] < 3.0
    assert np.isnan(line.row.seconds)
    with pytest.raises(FileNotFoundError, match="no dense cloud"):
        stored(folder)(Cloud(cloud.points[:-1]), 4.0)


def test_the_ablation(truth, networks, tmp_path):
    """Five recipes and the full model, with the paper's numbers; then the same of ours."""
    shape, samples = truth
    store = RowStore(tmp_path / "rows.json", Setting([shape], samples, surfaces=False))
    lines = list(tables.ablation(store, networks, ratio=4))
    assert [line.method for line in lines][5::6] == ["full model", "ours, full model"]
    assert [line.row is not None for line in lines] == [False] * 5 + [True] + [False] * 6
    assert lines[6].method == "ours, without feature recalibration"
    assert "--recipe standard_no_recalibration --name" in lines[6].why
    assert lines[0].printed == printed.ABLATION["paper_no_recalibration"]


def test_commands_are_told_once_and_no_time_of_points_that_were_there():
    """Two lines of one network have one command; a line that upsampled nothing has no seconds."""
    made = [
        tables.Line("ours", ratio, rows.Row({"CD": 0.4}, seconds, 9.0), command="pugeo train")
        for ratio, seconds in ((4, 12.0), (8, 0.2))
    ]
    table = lines_table(made, ("CD",))
    assert table.count("`pugeo train`") == 1
    first, second = [line for line in table.splitlines() if line.startswith(("| 4 ", "| 8 "))]
    assert first.endswith("| 12 |")
    assert second.endswith("|  |")


def test_a_section_says_how_it_was_made():
    """Title, command, seconds, and the parts that are not empty."""
    text = section("Table 9", "pugeo reproduce --part x", 1234.5, "", "| a |")
    expected = "## Table 9\n\n`pugeo reproduce --part x`, 1,234 seconds of one core.\n\n| a |\n"
    assert text == expected


def test_robustness_figures(truth, tmp_path):
    """Few and noisy points with numbers of input and output; a LiDAR frame without."""
    shape, _ = truth
    few = few_points(twice, shape)
    assert len(few.sparse) == 128
    assert len(few.dense) == 16 * 128
    assert few.figures["P2F input"] == pytest.approx(0.0, abs=1e-6)
    noisy = noisy_points(twice, shape, 0.02)
    assert 5 < noisy.figures["P2F input"] < 30
    frame = tmp_path / "frame.bin"
    rng = np.random.default_rng(0)
    rng.uniform(-20, 20, (4000, 4)).astype(np.float32).tofile(frame)
    kitti = lidar(twice, frame)
    assert kitti.figures == {}
    assert (kitti.sparse.points[:, 0] > 0).all()
    draw([few, noisy, kitti], tmp_path / "figure.png", pixels=80)
    assert (tmp_path / "figure.png").stat().st_size > 3000
    for broken in (b"", b"12345"):
        frame.write_bytes(broken)
        with pytest.raises(ValueError, match="no float32"):
            lidar(twice, frame)
    np.full((3, 4), 100, dtype=np.float32).tofile(frame)
    with pytest.raises(ValueError, match="no point within"):
        lidar(twice, frame)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_command(truth, networks, tmp_path, monkeypatch):
    """One part after the other into one document; an unknown part is refused."""
    shape, samples = truth
    document = tmp_path / "docs/paper.md"
    common = ["reproduce", "--meshes", str(samples / "meshes"), "--samples", str(samples)]
    common += ["--networks", str(networks), "--out", str(document), "--no-surfaces"]
    common += ["--model", "fast"]
    monkeypatch.setattr(tables, "RATIOS", (4,))
    for part in ("comparison", "ablation", "geometry"):
        result = CliRunner().invoke(app, [*common, "--part", part])
        assert result.exit_code == 0, result.output
    text = document.read_text()
    assert text.index("## Table 3") < text.index("## Figure")
    assert "pugeo reproduce --part geometry" in text
    assert "7 steps took 0.0 h on a CPU" in text
    assert (document.parent / "images/paper/geometry_fast.png").exists()
    refused = CliRunner().invoke(app, [*common, "--part", "table9"])
    assert refused.exit_code != 0
    assert "table9" in refused.output
    assert shape.name == "ball"


def test_a_line_without_a_row():
    """A dash for each column, the paper's number beside it, and the reason below."""
    line = tables.Line("MPU", 12, None, "cannot", printed.COMPARISON["mpu", 8])
    text = lines_table([line, replace(line, printed=None)])
    assert "| 12 | MPU | - (0.447) |" in text
    assert "| 12 | MPU | - | - |" in text
    assert text.count("- MPU, R=12: cannot") == 2
