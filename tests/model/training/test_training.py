# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

pytest.importorskip("igl", reason="training needs the train extra")

from pugeo_model.errors import BadOption
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture, PUGeoNet
from pugeo_model.training import corpus
from pugeo_model.training.augment import Mix, draw
from pugeo_model.training.batches import Batches
from pugeo_model.training.corpus import Shape, load_shape, mesh_files
from pugeo_model.training.losses import JointLoss, Weights
from pugeo_model.training.recipes import available_recipes, read_recipe
from pugeo_model.training.run import load_shapes, run
from pugeo_model.training.trainer import Recipe, Trainer, learning_rate
from pugeo_model.weights import available, read_card

SMALL = Architecture(features=32, options=(("width", 16), ("edge_width", 16)))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder with a bumpy ball, made here."""
    folder = tmp_path_factory.mktemp("meshes")
    rows, columns = 24, 48
    theta = np.linspace(0.05, np.pi - 0.05, rows)
    phi = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    r = 1 + 0.1 * np.sin(3 * p) * np.sin(t) ** 3
    points = np.stack([r * np.sin(t) * np.cos(p), r * np.sin(t) * np.sin(p), r * np.cos(t)], -1)
    lines = [f"OFF\n{rows * columns} {2 * (rows - 1) * columns} 0"]
    lines += [" ".join(f"{x:.6f}" for x in point) for point in points.reshape(-1, 3)]
    for i in range(rows - 1):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            lines += [f"3 {a} {a + columns} {b}", f"3 {b} {a + columns} {b + columns}"]
    (folder / "ball.off").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def shapes(meshes, tmp_path_factory):
    """The ball with its samples, cached in a folder of the test's own."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PUGEO_CACHE", str(cache))
        yield load_shapes(meshes)
        assert len(list(cache.glob("*.npz"))) == 1


def test_samples_are_cached_by_content(meshes, tmp_path, monkeypatch):
    """A second load samples nothing; another mesh of the same name is sampled anew."""
    cache = tmp_path / "cache"
    first = load_shape(mesh_files(meshes)[0], cache)
    monkeypatch.setattr(corpus, "poisson_disk", lambda *_: pytest.fail("sampled again"))
    again = load_shape(mesh_files(meshes)[0], cache)
    np.testing.assert_array_equal(first.pool, again.pool)
    assert [len(points) for points in again.inputs] == list(corpus.SIZES)
    changed = tmp_path / "ball.off"
    changed.write_text(mesh_files(meshes)[0].read_text().replace("0.9", "0.8"))
    with pytest.raises(pytest.fail.Exception, match="sampled again"):
        load_shape(changed, cache)


def test_empty_folder_is_an_error(tmp_path):
    """A folder without meshes says so."""
    with pytest.raises(FileNotFoundError, match="no mesh"):
        mesh_files(tmp_path)


def test_batches_depend_on_seed_and_step_alone(shapes):
    """Batch 5 is the same whoever asks for it and whatever was asked before."""
    one, two = (Batches(shapes, Mix(), 3, 10) for _ in range(2))
    one[0]
    (count, first), (same, second) = one[5], two[5]
    assert count == same
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.patch.points, b.patch.points)
        np.testing.assert_array_equal(a.truths, b.truths)


def test_thin_shapes_are_scanned_too():
    """However a needle lies to the scan lines, some fall on it."""
    rng = np.random.default_rng(0)
    pool = (rng.random((20_000, 3)) * [1, 0.01, 0.01]).astype(np.float32)
    none = np.empty((0, 3))
    inputs = (pool.astype(float),) * len(corpus.SIZES)
    needle = Shape("needle", none, none.astype(int), none, pool, inputs)
    lines = Mix(noisy=0, random=0, ramp=0, cut=0, lines=1)
    for _ in range(300):
        assert len(draw(needle, lines, rng)[0]) > 300


def test_truths_belong_to_the_core(shapes):
    """Every ground-truth sample is owned by charts that are trained in this patch."""
    _, samples = Batches(shapes, Mix(), 0, 10)[1]
    for sample in samples:
        assert len(sample.truths) > 100
        assert sample.owners.max() < sample.patch.core


def test_loss_falls(shapes, tmp_path):
    """Forty steps on one shape lower the loss by a fifth or more."""
    trainer = Trainer(shapes, Recipe(SMALL, steps=40, warmup=5, rate=4e-3), tmp_path)
    batches = Batches(shapes, Mix(), 0, 40)
    losses = []
    for trainer.step in range(40):
        losses.append(trainer._train(batches[trainer.step % 4])["loss"])
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:4])


def test_loss_is_finite_and_has_gradients_everywhere(shapes):
    """Every parameter takes part in the joint loss."""
    torch.manual_seed(0)
    net = PUGeoNet(SMALL)
    count, samples = Batches(shapes, Mix(), 0, 10)[2]
    total, parts = JointLoss(shapes)(net, count, samples, np.random.default_rng(0))
    total.backward()
    assert all(np.isfinite(value) for value in parts.values())
    silent = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert silent == []


def test_resumes_exactly(shapes, meshes, tmp_path):
    """Six steps in a row and three plus three give the same weights, bit for bit."""

    def train(folder, lengths):
        for steps in lengths:
            recipe = Recipe(SMALL, steps=steps, warmup=2, cooldown=0.0)
            run(shapes, [], meshes, recipe, folder, "small", "own.toml", 3, lambda *_: None)
        return (folder / "small.safetensors").read_bytes()

    assert train(tmp_path / "once", [6]) == train(tmp_path / "twice", [3, 6])
    for name in ("log.csv", "curves.png", "small.json", "checkpoint.pt"):
        assert (tmp_path / "once" / name).stat().st_size > 0


@pytest.mark.parametrize("name", available_recipes())
def test_recipes_of_released_weights(name):
    """Each can be read and makes a network; the card of the weights says what they say."""
    recipe = read_recipe(name)
    net = build_network(recipe.architecture)
    assert recipe.to_json()["architecture"] == net.architecture.to_json()
    if name in available():
        trained = read_card(name)["training"]["recipe"]
        assert json.dumps(trained) == json.dumps(recipe.to_json())


def test_the_default_recipe_is_that_of_the_default_weights():
    """What a file leaves out is as in the code: so both say the same."""
    assert read_recipe("standard") == Recipe()


def test_a_recipe_of_ones_own(tmp_path):
    """What it leaves out is as in the code; what it should not hold is told by name."""
    path = tmp_path / "mine.toml"
    path.write_text("steps = 7\n[architecture]\noptions = {width = 8}\n[mix]\nnoisy = 0.5\n")
    recipe = read_recipe(str(path))
    assert (recipe.steps, recipe.mix.noisy, recipe.rate) == (7, 0.5, Recipe().rate)
    assert recipe.architecture.options == (("width", 8),)
    for text, said in (("stepz = 1", "'stepz' is unknown"), ("mix = 3", "table"), ("=", "TOML")):
        path.write_text(text)
        with pytest.raises(BadOption, match=said):
            read_recipe(str(path))
    with pytest.raises(BadOption, match="standard"):
        read_recipe("nobodys")


def test_learning_rate_has_three_phases():
    """Rise, plateau, fall to zero."""
    recipe = Recipe(steps=1000, warmup=100, cooldown=0.2, rate=1.0)
    assert learning_rate(recipe, 0) == pytest.approx(0.01)
    assert learning_rate(recipe, 500) == 1.0
    assert learning_rate(recipe, 900) == pytest.approx(0.5)
    assert learning_rate(recipe, 999) == pytest.approx(0.005)


def test_a_run_starts_from_weights(shapes, meshes, tmp_path):
    """As they are, but for its first step; those of another architecture are refused."""
    recipe = Recipe(SMALL, steps=2, warmup=1)
    run(shapes, [], meshes, recipe, tmp_path / "first", "small", "own.toml", 2, lambda *_: None)
    weights = str(tmp_path / "first" / "small.safetensors")
    begun = Trainer(shapes, replace(recipe, start=weights), tmp_path / "second")
    for name, value in load_file(weights).items():
        torch.testing.assert_close(begun.net.state_dict()[name], value)
    assert begun.recipe.to_json()["start"] == weights
    with pytest.raises(BadOption, match="architecture"):
        Trainer(shapes, Recipe(start=weights), tmp_path / "third")


@pytest.mark.parametrize(
    "name", [name for name in available_recipes() if name.startswith("standard_no_")]
)
def test_an_ablation_of_ours_is_trained(name, shapes, tmp_path):
    """One step with a small network: the loss is finite; without normals nothing supervises T."""
    recipe = read_recipe(name)
    options = {**dict(recipe.architecture.options), "width": 16, "edge_width": 16}
    small = replace(recipe.architecture, features=32, head=32, options=tuple(options.items()))
    trainer = Trainer(shapes, replace(recipe, architecture=small, warmup=1), tmp_path)
    parts = trainer._train(trainer._batches()[0])
    assert np.isfinite(parts["loss"])
    if name == "standard_no_normals":
        assert recipe.weights.coarse_normal == recipe.weights.refined_normal == 0.0


def test_without_normal_weights_no_normal_has_a_say(shapes):
    """The loss is that of the other terms alone, those of blended normals left out too."""
    torch.manual_seed(0)
    net = PUGeoNet(SMALL)
    count, samples = Batches(shapes, Mix(), 0, 10)[2]

    def total(weights):
        loss, parts = JointLoss(shapes, weights)(net, count, samples, np.random.default_rng(0))
        return float(loss.detach()), parts

    bare, parts = total(Weights(coarse_normal=0.0, refined_normal=0.0))
    full, _ = total(Weights())
    w = Weights()
    extra = w.coarse_normal * parts["coarse_normal"] + w.refined_normal * parts["refined_normal"]
    assert full - bare == pytest.approx(extra + w.blended * parts["blended_normal"] / 6, rel=1e-4)
