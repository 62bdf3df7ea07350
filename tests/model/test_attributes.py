# SPDX-License-Identifier: Apache-2.0
"""Interpolation of attributes at new points."""

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.attributes import mark_labels, transfer_attributes

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]])


def test_no_attributes() -> None:
    """A cloud without attributes gives none."""
    assert transfer_attributes(Cloud(CORNERS), CORNERS) == (None, {})


def test_inverse_distance() -> None:
    """A mean over the three nearest by inverse distance, worked out by hand."""
    target = np.array([[0.25, 0.0, 0.0]])
    weights = 1 / np.array([0.25, 0.75, np.hypot(0.25, 1)])
    values = np.array([1.0, 2.0, 4.0, 1e9])
    colors = np.array([[0, 0, 0, 255], [255, 0, 0, 255], [0, 255, 0, 0], [7, 7, 7, 7]], np.uint8)
    found, scalars = transfer_attributes(
        Cloud(CORNERS, colors=colors, scalars={"v": values}), target
    )
    assert scalars["v"][0] == pytest.approx(values[:3] @ weights / weights.sum())
    assert found is not None
    expected = np.rint(weights @ colors[:3].astype(float) / weights.sum())
    np.testing.assert_array_equal(found[0], expected)


def test_on_a_source_point() -> None:
    """A target on a source point gets its values exactly, and dtypes are kept."""
    rng = np.random.default_rng(0)
    source = Cloud(
        rng.random((50, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (50, 3)).astype(np.uint8),
        scalars={
            "half": rng.random(50).astype(np.float16),
            "single": rng.random(50).astype(np.float32),
            "double": rng.random(50),
            "label": rng.integers(0, 9, 50).astype(np.int16),
            "mask": rng.random(50) > 0.5,
        },
    )
    colors, scalars = transfer_attributes(source, source.points.astype(np.float64))
    np.testing.assert_array_equal(colors, source.colors)
    for name, values in source.scalars.items():
        assert scalars[name].dtype == values.dtype
        np.testing.assert_array_equal(scalars[name], values)


def test_labels_are_never_mixed() -> None:
    """Between classes 1 and 9 there is no class 5: labels are those of the nearest point."""
    labels = {"class": np.array([1, 9, 9, 9], np.uint8)}
    _, scalars = transfer_attributes(
        Cloud(CORNERS, scalars=labels), np.array([[0.4, 0, 0], [0.6, 0, 0]])
    )
    assert scalars["class"].tolist() == [1, 9]


def test_missing_values() -> None:
    """NaN and infinity are excluded from the mean, and kept if no neighbour has a finite value."""
    targets = np.array([[0.25, 0.1, 0.0]])
    one = {"v": np.array([np.nan, 2.0, np.inf, 9.0])}
    assert transfer_attributes(Cloud(CORNERS, scalars=one), targets)[1]["v"].tolist() == [2.0]
    none = {"v": np.array([np.nan, np.nan, np.nan, 9.0])}
    assert np.isnan(transfer_attributes(Cloud(CORNERS, scalars=none), targets)[1]["v"]).all()
    # A target on a source point gets its value, also NaN.
    assert np.isnan(transfer_attributes(Cloud(CORNERS, scalars=one), CORNERS[:1])[1]["v"]).all()


def test_huge_values_do_not_overflow() -> None:
    """A mean of the largest floats is the largest float."""
    targets = np.random.default_rng(0).random((1000, 3))
    for values in (np.full(4, np.finfo(np.float32).max), np.full(4, np.finfo(np.float64).max)):
        _, scalars = transfer_attributes(Cloud(CORNERS, scalars={"v": values}), targets)
        np.testing.assert_allclose(scalars["v"], values[0])


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_points(count: int) -> None:
    """One or two source points are enough."""
    source = Cloud(CORNERS[:count], scalars={"v": np.full(count, 2.5), "k": np.full(count, 3)})
    _, scalars = transfer_attributes(source, CORNERS)
    assert scalars["v"].tolist() == [2.5] * 4
    assert scalars["k"].tolist() == [3] * 4


def test_large_offset_and_many_targets() -> None:
    """Brute force gives the same, far from the origin and for more targets than one block."""
    rng = np.random.default_rng(0)
    offset = np.array([448_262.0, 5_411_932.0, 251.0])
    source = Cloud(
        rng.random((300, 3)) + offset,
        colors=rng.integers(0, 256, (300, 4)).astype(np.uint8),
        scalars={"v": rng.random(300), "k": np.arange(300)},
    )
    targets = rng.random((70_000, 3)) + offset
    near, weights = [], []
    for part in np.array_split(targets, 40):
        distance = np.linalg.norm(source.points - part[:, None], axis=2)
        near.append(np.argsort(distance, axis=1)[:, :3])
        weights.append(1.0 / np.take_along_axis(distance, near[-1], axis=1))
    rows, weight = np.concatenate(near), np.concatenate(weights)
    weight /= weight.sum(axis=1, keepdims=True)
    colors, scalars = transfer_attributes(source, targets)
    assert colors is not None
    assert source.colors is not None
    np.testing.assert_array_equal(scalars["k"], rows[:, 0])
    np.testing.assert_allclose(scalars["v"], (weight * source.scalars["v"][rows]).sum(axis=1))
    mean = (weight[:, :, None] * source.colors[rows]).sum(axis=1)
    assert np.abs(colors - mean).max() < 0.5 + 1e-6


def test_floating_labels() -> None:
    """Floats that are labels by name or by value are those of the nearest point, with a note."""
    scalars = {
        "scalar_Classification": np.array([2.5, 6, 6, 6], np.float32),
        "gps_time": np.array([1000.25, 1350.5, 1350.75, 1351]),
        "scalar_Whole": np.array([2.0, 6, np.nan, 6]),
        "height": np.array([0.5, 1, 2, 3]),
    }
    cloud = mark_labels(Cloud(CORNERS, scalars=scalars))
    assert cloud.labels == {"scalar_Classification", "gps_time", "scalar_Whole"}
    assert cloud.notes == (
        (
            "Scalars with whole values only are taken from the nearest point, not averaged: "
            "scalar_Whole."
        ),
    )
    _, found = transfer_attributes(cloud, np.array([[0.4, 0.1, 0], [0.6, 0, 0]]))
    assert found["scalar_Classification"].tolist() == [2.5, 6]
    assert found["gps_time"].tolist() == [1000.25, 1350.5]
    assert found["scalar_Whole"].tolist() == [2, 6]
    assert 0.5 < found["height"][0] < 1


@pytest.mark.parametrize(
    ("name", "label"),
    [
        *[(each, True) for each in ("label", "class", "scalar_Class", "ReturnNumber", "GpsTime")],
        *[(each, True) for each in ("return_number", "Point Source ID", "ring", "timestamp", "t")],
        *[(each, True) for each in ("rgb", "flags", "Number of Returns", "object_id", "scan")],
        *[(each, False) for each in ("intensity", "reflectance", "height", "confidence", "depth")],
        *[(each, False) for each in ("Illuminance (PCV)", "curvature", "temperature", "c3")],
    ],
)
def test_names_of_labels(name: str, label: bool) -> None:
    """Names of classes, returns, times, identifiers and flags are known as labels."""
    values = np.array([0.5, 1.5, 2.5, 3.5], np.float32)
    assert (name in mark_labels(Cloud(CORNERS, scalars={name: values})).labels) == label


def test_colors_of_16_bits() -> None:
    """Colours of 16 bits are averaged in 16 bits."""
    colors = np.array([[0, 1000, 65535]] * 4, np.uint16)
    found, _ = transfer_attributes(Cloud(CORNERS, colors=colors), np.array([[0.3, 0.2, 0]]))
    assert found is not None
    assert found.dtype == np.uint16
    assert found.tolist() == [[0, 1000, 65535]]
