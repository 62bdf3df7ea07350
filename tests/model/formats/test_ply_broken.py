# SPDX-License-Identifier: Apache-2.0
"""Broken and hostile PLY files: a clear error, soon, and nothing allocated."""

import struct
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError

Parse = Callable[..., Cloud]

XYZ = ["property float x", "property float y", "property float z"]
LITTLE, TEXT = "binary_little_endian", "ascii"


def ply(lines: list[str], body: bytes = b"", kind: str = LITTLE) -> bytes:
    return "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header", ""]).encode() + body


def test_truncated_binary_says_how_much(parse: Parse) -> None:
    """A short body is refused with bytes and rows, expected and found."""
    with pytest.raises(MalformedFileError) as caught:
        parse(ply(["element vertex 1000", *XYZ], b"x" * 125))
    assert caught.value.code == "truncated"
    assert caught.value.fields == {
        "expected_bytes": 12_000,
        "found_bytes": 125,
        "expected_rows": 1000,
        "found_rows": 10,
    }


def test_truncated_text_says_how_much(parse: Parse) -> None:
    """Missing lines are refused with the rows expected and found."""
    body = b"1.00000 2.00000 3.00000\n" * 4
    with pytest.raises(MalformedFileError) as caught:
        parse(ply(["element vertex 5", *XYZ], body, TEXT))
    assert caught.value.code == "truncated"
    assert caught.value.fields == {"expected_rows": 5, "found_rows": 4}


@pytest.mark.parametrize("kind", [LITTLE, TEXT])
def test_truncation_is_found_before_allocation(parse: Parse, kind: str) -> None:
    """A header that promises 20 million rows costs nothing when they are not there."""
    tracemalloc.start()
    try:
        with pytest.raises(MalformedFileError, match="ends too early"):
            parse(ply(["element vertex 20000000", *XYZ], b"1 2 3\n" * 100, kind))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_too_many_points(parse: Parse) -> None:
    """Four billion vertices are refused at once, with limit and value."""
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceededError) as caught:
            parse(ply(["element vertex 4000000000", *XYZ]))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
    assert caught.value.fields == {"name": "max_points", "limit": 20_000_000, "value": 4 * 10**9}


@pytest.mark.parametrize("junk", [b"x", b"comment x\n"])
def test_endless_header(parse: Parse, junk: bytes) -> None:
    """20 MB without an end of the header are refused after 64 KB."""
    data = b"ply\n" + junk * (20_000_000 // len(junk))
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceededError) as caught:
            parse(data)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
    assert caught.value.fields["name"] == "max_header_bytes"


def test_too_many_header_lines(parse: Parse) -> None:
    """A header is bounded in lines too."""
    with pytest.raises(LimitExceededError) as caught:
        parse(ply(["comment"] * 1_000 + ["element vertex 0", *XYZ]))
    assert caught.value.fields["name"] == "max_header_lines"


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["element vertex 1", *XYZ, XYZ[0]], "line 7: 'x' is declared twice"),
        (["element vertex 1", *XYZ, "element vertex 1"], "'vertex' is declared twice"),
        (["element vertex -1", *XYZ], "line 3: cannot understand 'element vertex -1'"),
        (["element vertex 1_0", *XYZ], "cannot understand"),
        (["element vertex ٣", *XYZ], "cannot understand"),
        (["element vertex 1" + "0" * 5000, *XYZ], "cannot understand"),
        (["element vertex", *XYZ], "cannot understand"),
        (["element vertex 1", "property quad x"], "cannot understand"),
        (["element vertex 1", *XYZ, "property list float int v"], "cannot understand"),
        (["element vertex 1", *XYZ, "property list uchar v"], "cannot understand"),
        (XYZ, "line 3: cannot understand"),
        (["format ascii 1.0", "element vertex 1", *XYZ], "cannot understand"),
        (["element vertex 1", *XYZ[:2]], "no column z"),
        (["element face 1", *XYZ], "no element 'vertex'"),
        (["element vertex 1", *XYZ[:2], "property list uchar float z"], "no column z"),
    ],
)
def test_bad_headers(parse: Parse, lines: list[str], match: str) -> None:
    """Every line that makes no sense is refused by number, and nothing is guessed."""
    with pytest.raises(MalformedFileError, match=match):
        parse(ply(lines, bytes(64)))


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"ply\n", "no line 'end_header'"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\n", "no line 'end_header'"),
        (b"ply\nend_header\n", "no line 'format'"),
        (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "cannot understand"),
    ],
)
def test_incomplete_headers(parse: Parse, data: bytes, match: str) -> None:
    """A header that stops, or lacks its format, is refused."""
    with pytest.raises(MalformedFileError, match=match):
        parse(data)


@pytest.mark.parametrize(
    ("body", "match"),
    [
        (b"1 2 3\n4 five 6\n7 8 9\n", "Line 9: 'five' is not a number"),
        (b"1 2 3\n4 5 6 7\n8 9 1\n", "Line 9 has too many values"),
        (b"1 2 3\n\n4 5\n7 8 9\n", "Line 10 has too few values"),
        (b"1 2 3\n4 1_0 6\n7 8 9\n", "Line 9: '1_0' is not a number"),
        (b"1 2 3\n4-5 6 7\n7 8 9\n", "Line 9: '4-5' is not a number"),
        (b"1 2 3\n4 5,5 6\n7 8 9\n", "Line 9: '5,5' is not a number"),
        (b"1 2 3\n4 0x5 6\n7 8 9\n", "Line 9: '0x5' is not a number"),
        (b"1 2 3\n4 5 \x006\n7 8 9\n", "Line 9"),
        (b"1 2 3\n4 5 \xff6\n7 8 9\n", "Line 9"),
    ],
)
def test_bad_text(parse: Parse, body: bytes, match: str) -> None:
    """A fault in a text body is reported with its line in the file."""
    with pytest.raises(MalformedFileError, match=match):
        parse(ply(["element vertex 3", *XYZ], body, TEXT))


@pytest.mark.parametrize("value", ["256", "-1", "1.5", "nan", "1e20"])
def test_text_outside_its_type(parse: Parse, value: str) -> None:
    """A number that its declared type cannot hold is refused instead of wrapping around."""
    lines = ["element vertex 1", *XYZ, "property uchar label"]
    with pytest.raises(MalformedFileError, match="Line 9 has a value of 'label'"):
        parse(ply(lines, f"1 2 3 {value}\n".encode(), TEXT))


def test_text_list_longer_than_its_line(parse: Parse) -> None:
    """The length of a list cannot reach into the next line."""
    lines = ["element vertex 2", *XYZ, "property list int int v"]
    for length in ("3", "-1", "2000000000"):
        with pytest.raises(MalformedFileError, match="Line 9 has too few values"):
            parse(ply(lines, f"1 2 3 {length} 1\n1 2 3 1 1\n".encode(), TEXT))


@pytest.mark.parametrize("count_type", ["i", "I", "q", "Q"])
@pytest.mark.parametrize("length", [-1, 2**31 - 1, 2**62])
@pytest.mark.parametrize("row", [0, 1])
def test_binary_list_of_impossible_length(
    parse: Parse, count_type: str, length: int, row: int
) -> None:
    """A list of negative length, or one longer than the file, is refused without allocating it."""
    size = struct.calcsize(count_type)
    bad = (length % 2 ** (8 * size)).to_bytes(size, "little")
    good = (1).to_bytes(size, "little")
    head = struct.pack("<3f", 1, 2, 3)
    body = b"".join(head + (bad if each == row else good) + bytes(4) for each in range(3))
    name = {"i": "int", "I": "uint", "q": "int64", "Q": "uint64"}[count_type]
    lines = ["element vertex 3", *XYZ, f"property list {name} int v"]
    with pytest.raises(MalformedFileError) as caught:
        parse(ply(lines, body))
    assert caught.value.code in ("bad_list", "truncated")


def test_lists_that_eat_the_file(parse: Parse) -> None:
    """Lists that leave no room for the last rows are found, in fast path and walk alike."""
    lines = ["element vertex 3", *XYZ, "property list uchar int v"]
    row = struct.pack("<3fB", 1, 2, 3, 2) + bytes(8)
    for body in (row * 2 + row[:13], row + row[:12] + b"\x03" + bytes(12) + row[:14]):
        with pytest.raises(MalformedFileError) as caught:
            parse(ply(lines, body))
        assert caught.value.code == "truncated"
        assert caught.value.fields["found_rows"] == 2
        assert caught.value.fields["found_bytes"] == len(body)
        assert caught.value.fields["expected_bytes"] > len(body)


def test_very_long_line(parse: Parse) -> None:
    """A text body without line ends is refused after some megabytes."""
    with pytest.raises(LimitExceededError, match="longer than"):
        parse(ply(["element vertex 1", *XYZ], b"1 " * 4_000_000, TEXT))


def test_file_limit(parse: Parse) -> None:
    """The size of the file is checked first of all."""
    data = ply(["element vertex 10", *XYZ], np.zeros(30, "f4").tobytes())
    assert len(parse(data, max_bytes=len(data))) == 10
    with pytest.raises(LimitExceededError) as caught:
        parse(data, max_bytes=len(data) - 1)
    assert caught.value.fields["name"] == "max_bytes"
