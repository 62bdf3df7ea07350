# SPDX-License-Identifier: Apache-2.0
import base64
import io
import re
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from pugeo_client import Meta, Result
from pugeo_client._picture import SIZE, picture


def decoded(html: str) -> Any:
    """The picture inside of the HTML as ``(H, W, 3)`` floats from 0 to 1, read by matplotlib."""
    found = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert found is not None
    return matplotlib.image.imread(io.BytesIO(base64.b64decode(found[1])))[..., :3]


def sphere(count: int = 20_000) -> Any:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_sphere_is_a_disc() -> None:
    """A sphere covers a disc, bright in its middle where it faces the viewer."""
    normals = sphere().astype(np.float32)
    image = decoded(picture(sphere() * 7 + 1e6, normals, None, caption="x"))
    assert image.shape == (SIZE, SIZE, 3)
    covered = (image < 1).any(axis=2)
    assert 0.7 < covered.mean() < np.pi / 4 + 0.02
    assert not covered[:10, :10].any()
    middle = image[SIZE // 2 - 20 : SIZE // 2 + 20, SIZE // 2 - 20 : SIZE // 2 + 20]
    rim = image[SIZE // 2 - 20 : SIZE // 2 + 20, 6:12]
    assert middle.mean() > rim[(rim < 1).any(axis=2)].mean() + 0.2


def test_near_points_cover_far_ones() -> None:
    """Of two parallel squares only the nearer one, above, is seen, in its own colour."""
    across = np.stack(np.meshgrid(*[np.linspace(-1, 1, 200)] * 2), axis=-1).reshape(-1, 2)
    far = np.column_stack([across, np.zeros(len(across))])
    toward = np.array([0.52, -0.693, 0.5])
    points = np.concatenate([far + 0.3 * toward, far])
    colors = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], np.uint8), len(far), axis=0)
    image = decoded(picture(points, None, colors, caption="x"))
    center = image[SIZE // 2, SIZE // 2]
    assert center.tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.full((5, 3), np.nan),
        np.array([[0, 0, 0], [np.inf, 0, 0], [1, 1, 1]]),
        np.array([[1e300, 0, 0], [-1e300, 0, 0]]),
        np.full((4, 3), 5e6),
    ],
)
def test_clouds_without_extent(points: Any) -> None:
    """Empty, single, equal, infinite and huge coordinates give a picture without a warning."""
    assert decoded(picture(points, None, None, caption="x")).shape == (SIZE, SIZE, 3)


def test_a_result_in_a_notebook(ply_bytes: bytes) -> None:
    """A result has a small picture; one whose arrays are not read has a text."""
    html = Result(Meta(points_out=3), format="ply", data=ply_bytes)._repr_html_()
    assert "&lt;Result 3 points" in html
    assert len(html) < 200_000
    decoded(html)
    text = Result(Meta(), format="json", data=b"{}")._repr_html_()
    assert text.startswith("&lt;Result")
    big = sphere(300_000).astype(np.float32)
    assert len(picture(big, big, None, caption="")) < 400_000
