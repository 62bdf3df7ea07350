# SPDX-License-Identifier: Apache-2.0
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("igl", reason="training needs the train extra")

from pugeo_model.errors import BadOptionError
from pugeo_model.geometry.overlapping import PATCH_POINTS
from pugeo_model.network.patch_networks.output import PatchOutput
from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.patches import corpus
from pugeo_model.training.patches.batches import PatchBatches
from pugeo_model.training.patches.corpus import load_pair
from pugeo_model.training.patches.losses import PatchLoss, chamfer, repulsion, unoriented
from pugeo_model.training.patches.settings import Augmentation, PatchSettings, PatchWeights
from pugeo_model.training.patches.trainer import PatchTrainer
from pugeo_model.training.recipes import available_recipes, read_recipe, with_ratio
from pugeo_model.training.run import run
from pugeo_model.training.trainer import Recipe

TINY = Architecture("pugeo-net", 16, (("ratio", 4), ("k", 6), ("width", 8), ("fused", 16)), 8)
PATCH_RECIPES = [name for name in available_recipes() if read_recipe(name).patches]


def ball(rows=24, columns=48):
    """Vertices and faces of a unit sphere."""
    theta = np.linspace(0.0, np.pi, rows)
    phi = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    vertices = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1)
    faces = []
    for i in range(rows - 1):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            faces += [(a, a + columns, b), (b, a + columns, b + columns)]
    return 0.5 * vertices.reshape(-1, 3), np.array(faces)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder with a ball."""
    folder = tmp_path_factory.mktemp("meshes")
    vertices, faces = ball()
    lines = [f"OFF\n{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(f"{x:.6f}" for x in vertex) for vertex in vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    (folder / "ball.off").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def shapes(meshes, tmp_path_factory):
    """The ball with its samples, cached in a folder of the test's own."""
    from pugeo_model.training.run import load_shapes

    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PUGEO_CACHE", str(cache))
        yield load_shapes(meshes)


@pytest.fixture(scope="module")
def pairs(shapes, tmp_path_factory):
    """Sparse and dense samples of the ball, R=4."""
    return [load_pair(shapes[0], 4, tmp_path_factory.mktemp("pairs"))]


def test_pairs_are_even_samples_with_normals(pairs):
    """M and R M points of the sphere, whose normals point as the points do."""
    (pair,) = pairs
    assert pair.sparse.shape == (5000, 6)
    assert pair.dense.shape == (20_000, 6)
    for part in (pair.sparse, pair.dense):
        points, normals = part[:, :3], part[:, 3:]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        assert (2 * points * normals).sum(axis=1).mean() > 0.99


def test_pairs_are_cached(shapes, tmp_path, monkeypatch):
    """A second load samples nothing; another ratio is sampled anew."""
    first = load_pair(shapes[0], 2, tmp_path)
    monkeypatch.setattr(corpus, "poisson_disk", lambda *_: pytest.fail("sampled again"))
    np.testing.assert_array_equal(load_pair(shapes[0], 2, tmp_path).dense, first.dense)
    with pytest.raises(pytest.fail.Exception, match="sampled again"):
        load_pair(shapes[0], 3, tmp_path)


def test_a_batch_holds_the_same_surface_twice(pairs):
    """Sparse and dense patches lie on one sphere, their normals along its radii."""
    batch = PatchBatches(pairs, 4, 256, 3, Augmentation(jitter=0.0), seed=0)[5]
    assert batch.points.shape == batch.normals.shape == (3, 256, 3)
    assert batch.dense.shape == batch.dense_normals.shape == (3, 1024, 3)
    for sparse, normals, dense, dense_normals in zip(
        batch.points, batch.normals, batch.dense, batch.dense_normals, strict=True
    ):
        # The centre of the sphere, by least squares from |x - c|^2 = r^2.
        system = np.concatenate([2 * sparse, np.ones((256, 1))], axis=1).astype(np.float64)
        solved = np.linalg.lstsq(system, (sparse.astype(np.float64) ** 2).sum(1), rcond=None)[0]
        centre, radius = solved[:3], np.sqrt(solved[3] + solved[:3] @ solved[:3])
        for points, directions in ((sparse, normals), (dense, dense_normals)):
            out = (points - centre) / radius
            np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, atol=0.02)
            assert (out * directions).sum(axis=1).min() > 0.95
        # Both are the neighbourhood of the same seed.
        reach = [np.linalg.norm(p - sparse.mean(0), axis=1).max() for p in (sparse, dense)]
        assert reach[0] == pytest.approx(reach[1], rel=0.1)


def test_batches_depend_on_seed_and_step_alone(pairs):
    """Batch 5 is the same whoever asks for it and whatever was asked before."""
    one, two = (PatchBatches(pairs, 4, 64, 2, Augmentation(), seed=3) for _ in range(2))
    one[0]
    np.testing.assert_array_equal(one[5].points, two[5].points)
    assert not np.array_equal(one[5].points, one[6].points)


def test_augmentation(pairs):
    """Without any, patches are of radius 1; with it, they are scaled, turned and perturbed."""
    still = PatchBatches(pairs, 4, 64, 1, Augmentation(0.0, rotate=False, jitter=0.0), seed=0)[0]
    assert np.linalg.norm(still.points[0], axis=1).max() == pytest.approx(1.0, abs=1e-5)
    scaled = PatchBatches(pairs, 4, 64, 1, Augmentation(0.2, rotate=False, jitter=0.0), seed=0)[0]
    factor = np.linalg.norm(scaled.points[0], axis=1).max()
    assert 0.8 <= factor <= 1.2
    np.testing.assert_allclose(scaled.points, factor * still.points, atol=1e-5)
    np.testing.assert_allclose(scaled.dense, factor * still.dense, atol=1e-5)
    shaken = PatchBatches(pairs, 4, 64, 1, Augmentation(0.0, rotate=False, jitter=0.01), seed=0)[0]
    noise = shaken.points - still.points
    assert 0.005 < noise.std() < 0.015
    assert np.abs(noise).max() <= 0.03 + 1e-5
    np.testing.assert_array_equal(shaken.dense, still.dense)
    turned = PatchBatches(pairs, 4, 64, 1, Augmentation(0.0, jitter=0.0), seed=0)[0]
    inner = (turned.points * turned.normals).sum(-1)
    np.testing.assert_allclose(inner, (still.points * still.normals).sum(-1), atol=1e-5)


def test_chamfer_by_hand():
    """Predictions 0 and 3, truths 1 and 7: (1 + 2) / 2 + (1 + 4) / 2, distances not squared."""
    line = torch.tensor([[[0.0, 0, 0], [3, 0, 0]]]), torch.tensor([[[1.0, 0, 0], [7, 0, 0]]])
    distance, phi = chamfer(*line)
    assert float(distance) == pytest.approx(1.5 + 2.5)
    assert phi.tolist() == [[0, 0]]


def test_the_normal_loss_is_the_smaller_of_both_signs():
    """0 for either sign of the true normal, 2 at a right angle; the printed max is 4 and 2."""
    truth = torch.tensor([0.0, 0.0, 1.0]).expand(3, 3)
    normals = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    assert unoriented(normals, truth).tolist() == [0.0, 0.0, 2.0]


def test_repulsion_by_hand():
    """Two points at distance 0.02, h = 0.03: minus d exp(-d^2 / h^2); it pushes them apart."""
    points = torch.tensor([[[0.0, 0, 0], [0.02, 0, 0]]], requires_grad=True)
    loss = repulsion(points, neighbours=2)
    assert loss.item() == pytest.approx(-0.02 * np.exp(-4 / 9), rel=1e-4)
    loss.backward()
    assert points.grad is not None
    assert points.grad[0, 0, 0] > 0 > points.grad[0, 1, 0]


def test_the_joint_loss_adds_up():
    """100 Chamfer + coarse + refined; refined normals compare with that of the nearest point."""
    points = torch.tensor([[[[0.0, 0, 0], [1, 0, 0]]]])
    dense = torch.tensor([[[0.1, 0, 0], [1.0, 0, 0]]])
    up, along = torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0])
    output = PatchOutput(points, torch.stack([up, up])[None, None], along[None, None])
    total, parts = PatchLoss()(output, up[None, None], dense, torch.stack([up, along])[None])
    assert parts["chamfer"] == pytest.approx(0.05 + 0.05)
    assert parts["coarse_normal"] == pytest.approx(2.0)
    assert parts["refined_normal"] == pytest.approx((0.0 + 2.0) / 2)
    assert total.item() == pytest.approx(100 * 0.1 + 2.0 + 1.0)
    bare, parts = PatchLoss()(PatchOutput(points), up[None, None], dense, dense)
    assert list(parts) == ["chamfer"]
    assert bare.item() == pytest.approx(10.0)
    weights = PatchWeights(repulsion=2.0)
    assert "repulsion" in PatchLoss(weights)(PatchOutput(points), up[None, None], dense, dense)[1]


@pytest.mark.parametrize("name", PATCH_RECIPES)
def test_one_step_of_every_recipe(name, shapes, tmp_path):
    """The network as it is, on two patches: the loss is finite, and a step changes the weights."""
    recipe = read_recipe(name)
    assert recipe.patches is not None
    assert recipe.patches.size == PATCH_POINTS
    recipe = replace(recipe, patches=replace(recipe.patches, batch=2))
    trainer = PatchTrainer(shapes, recipe, tmp_path)
    before = {key: value.clone() for key, value in trainer.net.named_parameters()}
    parts = trainer._train(trainer._batches()[0])
    assert np.isfinite(parts["loss"])
    # The last layer of the input transform starts at zero, and what is below it has no say yet.
    still = [
        key
        for key, value in trainer.net.named_parameters()
        if torch.equal(value, before[key]) and "backbone.transform." not in key
    ]
    biases = [key for key in still if key.endswith("bias")]
    assert still == biases  # those that a batch norm behind them takes out again


@pytest.mark.slow
def test_loss_falls(shapes, tmp_path):
    """Sixty steps of a small network on four batches lower every part of the loss."""
    recipe = Recipe(TINY, steps=60, warmup=1, rate=5e-3, clip=100.0, patches=PatchSettings(batch=2))
    trainer = PatchTrainer(shapes, recipe, tmp_path)
    batches = trainer._batches()
    parts = [trainer._train(batches[step % 4]) for step in range(60)]
    for name in ("chamfer", "coarse_normal", "refined_normal"):
        values = [part[name] for part in parts]
        assert np.mean(values[-4:]) < 0.97 * np.mean(values[:4]), name


@pytest.mark.slow
def test_resumes_exactly(shapes, meshes, tmp_path):
    """Four steps in a row and two plus two give the same weights, bit for bit."""

    def train(folder, lengths):
        for steps in lengths:
            recipe = Recipe(TINY, steps=steps, warmup=1, cooldown=0.0, patches=PatchSettings(64, 2))
            run(shapes, shapes, meshes, recipe, folder, "tiny", "own.toml", 2, lambda *_: None)
        return (folder / "tiny.safetensors").read_bytes()

    assert train(tmp_path / "once", [4]) == train(tmp_path / "twice", [2, 4])


def test_sigterm_saves(shapes, meshes, tmp_path):
    """The step in progress ends, then all is written, and the run can be resumed."""
    recipe = Recipe(TINY, steps=50, warmup=1, patches=PatchSettings(64, 2))
    before = signal.getsignal(signal.SIGTERM)  # another one if coverage is measured

    def tick(step, _words):
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    assert not run(shapes, [], meshes, recipe, tmp_path, "tiny", "own.toml", 40, tick)
    assert (tmp_path / "tiny.safetensors").exists()
    resumed = PatchTrainer(shapes, recipe, tmp_path)
    assert 3 <= resumed.step <= 4
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_recipe_built_on_another(tmp_path):
    """It holds the differences; options of another network are not taken over."""
    paper, ablation = read_recipe("paper"), read_recipe("paper_no_normals")
    options = dict(ablation.architecture.options)
    assert options.pop("normals") is False
    assert options == dict(paper.architecture.options)
    assert ablation.patches == paper.patches
    assert dict(read_recipe("pu_net_m").architecture.options) == {"ratio": 4, "normals": True}
    settings = read_recipe("pu_net").patches
    assert settings is not None
    assert settings.weights.chamfer == 100.0
    assert settings.weights.repulsion == 1.0
    path = tmp_path / "circle.toml"
    path.write_text(f'base = "{path}"\n')
    with pytest.raises(BadOptionError, match="after one another"):
        read_recipe(str(path))
    path.write_text('base = "paper"\n[patches.augmentation]\njiter = 1\n')
    with pytest.raises(BadOptionError, match="'jiter' is unknown"):
        read_recipe(str(path))


def test_another_ratio():
    """A recipe of a patch network serves every R; that of charts has none."""
    assert dict(with_ratio(read_recipe("paper"), 16).architecture.options)["ratio"] == 16
    with pytest.raises(BadOptionError, match="patch networks"):
        with_ratio(read_recipe("standard"), 8)
