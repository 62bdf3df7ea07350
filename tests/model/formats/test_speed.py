# SPDX-License-Identifier: Apache-2.0
"""A million points: bounds some ten times above what is measured on two busy cores."""

import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.formats import read, write

COUNT = 1_000_000


@pytest.fixture(scope="module")
def million() -> Cloud:
    """A million points with normals and colours."""
    rng = np.random.default_rng(0)
    return Cloud(
        rng.random((COUNT, 3), np.float32),
        rng.random((COUNT, 3), np.float32),
        rng.integers(0, 256, (COUNT, 3)).astype(np.uint8),
    )


def seconds(call: Callable[[], object]) -> float:
    start = time.thread_time()
    call()
    return time.thread_time() - start


def test_binary_from_every_kind_of_file(million: Cloud, tmp_path: Path) -> None:
    """Binary PLY reads in a fraction of a second, from memory and from a spooled upload too."""
    path = tmp_path / "cloud.ply"
    assert seconds(lambda: write(million, path)) < 2.0
    data = path.read_bytes()
    with tempfile.SpooledTemporaryFile(1 << 20) as spooled:
        spooled.write(data)
        spooled.seek(0)
        assert seconds(lambda: read(path)) < 1.0
        assert seconds(lambda: read(io.BytesIO(data))) < 1.0
        assert seconds(lambda: read(spooled)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ply-ascii", "json", "xyz"])
def test_text(name: str, million: Cloud) -> None:
    """A million rows of text read in seconds, and come back."""
    buffer = io.BytesIO()
    assert seconds(lambda: write(million, buffer, format=name)) < 30.0
    buffer.seek(0)
    back: list[Cloud] = []
    assert seconds(lambda: back.append(read(buffer, format=name))) < 40.0
    np.testing.assert_array_equal(back[0].points.astype(np.float32), million.points)


@pytest.mark.slow
def test_lists_of_different_lengths() -> None:
    """Finding a million rows of different lengths takes no Python for each row."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(2, 9, COUNT)
    starts = np.concatenate([[0], np.cumsum(13 + 4 * lengths)])
    body = np.zeros(starts[-1], np.uint8)
    points = rng.random((COUNT, 3)).astype("<f4")
    body[starts[:-1, None] + np.arange(12)] = points.view(np.uint8).reshape(COUNT, 12)
    body[starts[:-1] + 12] = lengths
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {COUNT}\nproperty float x\n"
        "property float y\nproperty float z\nproperty list uchar int views\nend_header\n"
    )
    file = io.BytesIO(header.encode() + body.tobytes())
    back: list[Cloud] = []
    # Compiling takes most of it.
    assert seconds(lambda: back.append(read(file))) < 15.0
    np.testing.assert_array_equal(back[0].points, points)
