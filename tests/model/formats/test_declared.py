# SPDX-License-Identifier: Apache-2.0
"""Sizes that headers declare are known and bounded before a point is read."""

import io
import resource
import struct
import zipfile
from typing import Any

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError
from pugeo_model.formats import declared, read, write
from pugeo_model.formats.limits import Declared, Limits

POINTS = np.random.default_rng(0).normal(size=(50, 3))
CLOUD = Cloud(POINTS, scalars={"intensity": np.linspace(0, 1, 50, dtype=np.float32)})
STATED = ["ply", "ply-ascii", "npz", "npy", "pcd", "las", "laz"]


def written(format: str, cloud: Cloud = CLOUD) -> io.BytesIO:
    """The bytes of a cloud."""
    buffer = io.BytesIO()
    write(cloud, buffer, format=format)
    buffer.seek(0)
    return buffer


@pytest.mark.parametrize("format", STATED)
def test_the_header_states_the_size(format: str) -> None:
    """Points and bytes of a row are known from the header alone; the position stays."""
    file = written(format)
    size = declared(file)
    assert size is not None
    assert size.points == 50
    assert size.row_bytes >= 12
    assert file.tell() == 0


@pytest.mark.parametrize("format", ["xyz", "json", "ptx"])
def test_text_states_none(format: str) -> None:
    """A format without a size in its header has none."""
    assert declared(written(format)) is None


@pytest.mark.parametrize("format", STATED)
def test_bytes_are_bounded_before_points_are_read(format: str) -> None:
    """A cloud that unpacks to more bytes than allowed is refused by its header."""
    file = written(format)
    size = len(file.getvalue())
    least = 50 * (declared(file) or Declared(0, 0)).row_bytes
    limits = Limits(max_bytes=max(size, least - 1))
    if least > limits.max_bytes:
        with pytest.raises(LimitExceededError) as caught:
            read(file, limits=limits)
        assert caught.value.fields["name"] == "max_bytes"
    with pytest.raises(LimitExceededError, match="limit of 49"):
        read(file, limits=Limits(max_points=49))


def test_columns_of_a_small_archive_are_counted() -> None:
    """A thousand constant columns that deflate to nothing count with all their bytes."""
    columns: dict[str, Any] = {f"s{i}": np.full(2000, 0.5) for i in range(1000)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, points=np.zeros((2000, 3)), **columns)
    assert len(buffer.getvalue()) < 400_000
    buffer.seek(0)
    assert declared(buffer) == Declared(2000, 8024)
    with pytest.raises(LimitExceededError, match="unpacks to"):
        read(buffer, limits=Limits(max_bytes=16_000_000))


@pytest.mark.parametrize("single", [False, True])
def test_a_header_of_blanks_is_not_read(single: bool) -> None:
    """A header that claims gigabytes is refused by its length: it would unpack to as many."""
    claimed = 64 << 20
    header = b"\x93NUMPY\x02\x00" + struct.pack("<I", claimed) + b" " * claimed
    buffer = io.BytesIO(header)
    if not single:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("points.npy", header)
    del header
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    buffer.seek(0)
    with pytest.raises(LimitExceededError, match="header of array") as caught:
        read(buffer)
    assert caught.value.fields["value"] == claimed
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < claimed >> 11


def test_a_row_counts_all_attributes() -> None:
    """The bytes of a row are those of points, normals, colours and scalars."""
    attributes: dict[str, Any] = {
        "normals": np.zeros((50, 3), np.float32),
        "colors": np.zeros((50, 4), np.uint16),
        "scalars": {"a": np.zeros(50, np.uint8), "b": np.zeros(50)},
    }
    assert Cloud(POINTS, **attributes).row_bytes == 24 + 12 + 8 + 1 + 8
