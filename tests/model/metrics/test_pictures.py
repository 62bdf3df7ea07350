# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")
pytest.importorskip("matplotlib", reason="pictures need the evaluate extra")

from matplotlib import colormaps
from matplotlib.image import imread

from pugeo_model.cloud import Cloud
from pugeo_model.metrics.evaluation import Case, Measured, Truth, measure, measure_surface
from pugeo_model.metrics.pictures import LARGEST_ERROR, draw
from pugeo_model.metrics.rasteriser import BACKGROUND, Camera, splat

SIDE = 120


@pytest.fixture
def at_distance(ball, sphere, tmp_path, monkeypatch):
    """A function that draws points at one distance from the ball and returns the pixels."""
    monkeypatch.setattr("pugeo_model.metrics.evaluation._SURFACE_SAMPLES", 5_000)
    monkeypatch.setattr("pugeo_model.metrics.pictures._DISCS", 5_000)
    truth = Truth(ball)

    def picture(distance, surface=None):
        _, _, foot = truth.distance.nearest(0.5 * sphere)
        points = foot + distance * sphere
        row = measure(points, sphere, points, truth)
        if surface is not None:
            row |= measure_surface(surface, truth)
        cloud = Cloud(points, normals=sphere.astype(np.float32))
        measured = Measured(Case("2000", 1, 2000), truth, row, cloud, surface)
        draw(measured, tmp_path / "out.png", SIDE)
        return imread(tmp_path / "out.png")[:, :, :3]

    return picture


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 5.0])
def test_colours_are_those_of_the_bar(at_distance, fraction):
    """Points at one distance from the surface have the colour of the bar at that distance."""
    image = at_distance(fraction * LARGEST_ERROR)
    assert image.shape[1] == 2 * SIDE
    middle = image[50 + SIDE // 3 : 50 + 2 * SIDE // 3, SIDE // 3 : 2 * SIDE // 3]
    np.testing.assert_allclose(
        middle, np.broadcast_to(colormaps["turbo"](fraction)[:3], middle.shape), atol=0.03
    )


def test_a_surface_gets_its_panel(at_distance, ball):
    """With a reconstructed surface there is a third panel; a sphere is a disc without gaps."""
    truth = Truth(ball)
    image = at_distance(0.0, (truth.vertices, truth.faces))
    assert image.shape[1] == 3 * SIDE
    panel = image[50 : 50 + SIDE, 2 * SIDE :]
    drawn = np.abs(panel - BACKGROUND ** (1 / 2.2)).max(axis=2) > 0.02
    radius = SIDE / 2 / 1.08
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    assert drawn[np.hypot(x, y) < radius - 3].all()
    assert not drawn[np.hypot(x, y) > radius + 6].any()


def test_light_comes_from_above_left(sphere):
    """A shaded sphere is brightest above left, darkest below right; unshaded it has one colour."""
    camera = Camera.on(sphere, turn=0.0, tilt=0.0, pixels=100)
    gray = np.full((len(sphere), 3), 0.5)
    lit = splat(camera, sphere, gray, radius=0.08, normals=sphere)
    assert lit[30, 30, 0] > lit[50, 50, 0] > lit[75, 75, 0] > lit[2, 2, 0]
    flat = splat(camera, sphere, gray, radius=0.08, normals=sphere, lit=False)
    np.testing.assert_allclose(flat[20:80, 40:60], 0.5 ** (1 / 2.2), atol=1e-6)


def test_the_near_side_hides_the_far_one():
    """Of two surfaces only the nearer one is drawn, in any order of the points."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 40)] * 2), axis=-1).reshape(-1, 2)
    near, far = np.insert(grid, 2, 0.5, axis=1), np.insert(grid, 2, -0.5, axis=1)
    red, blue = np.tile([1.0, 0, 0], (1600, 1)), np.tile([0, 0, 1.0], (1600, 1))
    camera = Camera.on(near, turn=0.0, tilt=0.0, pixels=64)
    for first, second, colors in ((near, far, (red, blue)), (far, near, (blue, red))):
        image = splat(
            camera,
            np.concatenate([first, second]),
            np.concatenate(colors),
            radius=0.08,
            normals=np.tile([0.0, 0, 1], (3200, 1)),
            lit=False,
        )
        assert (image[8:56, 8:56, 0] > 0.99).all()
        assert (image[8:56, 8:56, 2] < 0.01).all()
