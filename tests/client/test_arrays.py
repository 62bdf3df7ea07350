# SPDX-License-Identifier: Apache-2.0
import io
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pugeo_client import Meta, Result
from pugeo_client._arrays import pack_npz, to_cloud_arrays
from pugeo_client.errors import SourceError

POINTS = np.array([[0.0, 1, 2], [3, 4, 5]])


def sent(source: Any) -> dict[str, Any]:
    """The arrays that the service would read."""
    return dict(np.load(io.BytesIO(pack_npz(to_cloud_arrays(source)))))


@pytest.mark.parametrize(
    "source",
    [
        POINTS.tolist(),
        tuple(map(tuple, POINTS)),
        torch.tensor(POINTS),
        torch.tensor(POINTS, requires_grad=True),
        torch.tensor(POINTS.astype(int)),
        {"points": torch.tensor(POINTS)},
        {"points": POINTS.tolist(), "normals": None, "scalars": None},
    ],
)
def test_lists_and_tensors(source: Any) -> None:
    """Nested lists and torch tensors, also inside of a dict, are points in double precision."""
    arrays = sent(source)
    assert list(arrays) == ["points"]
    assert arrays["points"].dtype == np.float64
    np.testing.assert_array_equal(arrays["points"], POINTS)


def test_a_float_tensor_keeps_its_precision() -> None:
    """float32 stays float32; columns 4 to 6 are normals; other orders of memory are sent."""
    six = torch.arange(12, dtype=torch.float32).reshape(6, 2).T
    arrays = sent(six)
    assert arrays["points"].dtype == arrays["normals"].dtype == np.float32
    np.testing.assert_array_equal(arrays["normals"], six[:, 3:].numpy())


def test_names_of_scalars() -> None:
    """Any name is sent: beyond ASCII, and those of arguments of numpy.savez."""
    names = ["höhe über NN", "日本", "file", "allow_pickle", "a b"]
    arrays = sent({"points": POINTS, "scalars": {name: [1, 2] for name in names}})
    assert set(arrays) == {"points", *names}


@pytest.mark.parametrize(
    "source",
    [
        [],
        [1, 2, 3],
        [[1, 2], [3]],
        [[1, 2, "x"]],
        [[None, 1, 2]],
        3.5,
        object(),
        torch.tensor(POINTS).to(torch.bfloat16),
        torch.zeros(3),
        torch.zeros((2, 3), dtype=torch.complex64),
        {"points": POINTS, "scalars": [1, 2]},
        {"points": POINTS, "scalars": {5: [1, 2]}},
        {"points": POINTS, "scalars": {"a": [1, [2]]}},
        {"points": POINTS, "colors": object()},
        {"points": POINTS, 7: POINTS},
    ],
)
def test_what_is_no_cloud(source: Any) -> None:
    """Everything else is a SourceError."""
    with pytest.raises(SourceError):
        sent(source)


class Legacy:
    """Attributes of an `open3d.geometry.PointCloud`."""

    def __init__(self, normals: Any = (), colors: Any = ()) -> None:
        self.points = POINTS.tolist()
        self.normals = normals
        self.colors = colors

    def has_points(self) -> bool:
        return True


class Tensor:
    """Methods of an `open3d.core.Tensor`."""

    def __init__(self, values: Any) -> None:
        self._values = np.asarray(values)

    def cpu(self) -> "Tensor":
        return self

    def numpy(self) -> Any:
        return self._values


def test_attributes_of_open3d() -> None:
    """Both kinds of Open3D clouds are recognised by their attributes; nothing is imported."""
    assert list(sent(Legacy())) == ["points"]
    arrays = sent(Legacy(POINTS, [[0, 0.5, 1], [2.0, -1, np.nextafter(0.5, 0)]]))
    np.testing.assert_array_equal(arrays["normals"], POINTS)
    np.testing.assert_array_equal(arrays["colors"], [[0, 128, 255], [255, 0, 127]])
    attributes = {
        "positions": Tensor(POINTS.astype(np.float32)),
        "colors": Tensor(np.full((2, 3), 9, np.uint8)),
        "intensity": Tensor([[0.5], [0.6]]),
        "label": Tensor([1, 2]),
    }
    arrays = sent(SimpleNamespace(point=attributes))
    assert arrays["points"].dtype == np.float32
    assert arrays["intensity"].tolist() == [0.5, 0.6]
    assert arrays["label"].tolist() == [1, 2]
    assert arrays["colors"].dtype == np.uint8
    with pytest.raises(SourceError, match="positions"):
        sent(SimpleNamespace(point={"normals": Tensor(POINTS)}))
    with pytest.raises(SourceError, match="covariance"):
        sent(SimpleNamespace(point={**attributes, "covariance": Tensor(np.zeros((2, 3, 3)))}))
    assert "open3d" not in sys.modules


def test_clouds_of_open3d(ply_bytes: bytes) -> None:
    """A result becomes an Open3D cloud, which is sent as the same arrays, as is its tensor kind."""
    open3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    result = Result(Meta(), format="ply", data=ply_bytes)
    cloud = result.to_open3d()
    for source in (cloud, open3d.t.geometry.PointCloud.from_legacy(cloud)):
        arrays = sent(source)
        np.testing.assert_allclose(arrays["points"], result.points, rtol=1e-7)
        np.testing.assert_array_equal(arrays["normals"], result.normals)
        np.testing.assert_array_equal(arrays["colors"], result.colors)


def test_open3d_is_missing(ply_bytes: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Open3D the error says how to install it."""
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match="pip install open3d"):
        Result(Meta(), format="ply", data=ply_bytes).to_open3d()
