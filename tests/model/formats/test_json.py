# SPDX-License-Identifier: Apache-2.0
"""JSON documents."""

import json
from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]


def test_document(parse: Parse) -> None:
    """Points, normals, colours and scalars are read; whole numbers are labels."""
    cloud = parse(
        b"""\xef\xbb\xbf {"points": [[1, 2.5, -3e2], [0, 0, 0]], "normals": [[0,0,1],[0,1,0]],
        "colors": [[0, 128, 255], [1, 2, 3]], "scalars": {"class": [1, 2], "depth": [0.5, null],
        "mask": [true, false]}}"""
    )
    assert cloud.points.dtype == np.float64
    assert cloud.points.tolist() == [[1, 2.5, -300], [0, 0, 0]]
    assert cloud.normals is not None
    assert cloud.normals.tolist() == [[0, 0, 1], [0, 1, 0]]
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[0, 128, 255], [1, 2, 3]]
    assert [each.dtype.kind for each in cloud.scalars.values()] == ["i", "f", "b"]
    np.testing.assert_array_equal(cloud.scalars["depth"], [0.5, np.nan])


def test_nulls_and_nothing(parse: Parse) -> None:
    """Optional keys may be null; a document of no points is a cloud of no points."""
    empty = parse(b'{"points": [], "normals": null, "colors": null, "scalars": null}')
    assert len(empty) == 0
    assert len(parse(b'{"points": [], "normals": [], "colors": [], "scalars": {"a": []}}')) == 0


def test_float_colors(parse: Parse) -> None:
    """Colours with a decimal point are 0..1, with alpha or without."""
    cloud = parse(b'{"points": [[0,0,0],[1,1,1]], "colors": [[0, 0.5, 1, 1.0], [1, 1, 1, 0]]}')
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[0, 128, 255, 255], [255, 255, 255, 0]]


@pytest.mark.parametrize(
    ("document", "match"),
    [
        ('{"points": [[0,0,0]]', "truncated"),
        ('{"point": [[0,0,0]]}', "unknown field `point`.*Allowed keys are points"),
        ('{"normals": []}', "missing required field `points`"),
        ('{"points": [[0,0,0],[0,0]]}', r"length 3.*\$\.points\[1\]"),
        ('{"points": [[0,0,0,0]]}', r"length 3.*\$\.points\[0\]"),
        ('{"points": [[0,0,"1"]]}', r"got `str`.*\$\.points\[0\]\[2\]"),
        ('{"points": [[0,0,nan]]}', "invalid character"),
        ('{"points": [[0,0,1e999]]}', r"out of range.*"),
        ('{"points": [0,0,0]}', r"Expected `array`, got `int`.*\$\.points\[0\]"),
        ('{"points": null}', "Expected `array`, got `null`"),
        ('{"points": [[0,0,0]], "normals": []}', "'normals' has 0 rows, but 'points' has 1"),
        ('{"points": [[0,0,0]], "colors": [[0,0]]}', r"length >= 3.*\$\.colors\[0\]"),
        ('{"points": [[0,0,0],[1,1,1]], "colors": [[0,0,0],[0,0,0,0]]}', r"colors\[1\] has 4"),
        ('{"points": [[0,0,0]], "colors": [[0,0,65536]]}', r"colors\[0\]: whole numbers"),
        ('{"points": [[0,0,0]], "colors": [[0,-1,0]]}', r"colors\[0\]: whole numbers"),
        (
            '{"points": [[0,0,0]], "colors": [[0,1000000000000000000000000,0]]}',
            r"colors\[0\]: whole numbers",
        ),
        ('{"points": [[0,0,0]], "scalars": {"a": [1, 2]}}', "'scalars.a' has 2 rows"),
        ('{"points": [[0,0,0]], "scalars": {"a": ["x"]}}', r"\$\.scalars\.a\[0\]"),
        ('{"points": [[0,0,0]], "scalars": {"a": [1000000000000000000000000]}}', "beyond 64 bits"),
        ('{"points": [[0,0,0]], "scalars": [1]}', r"Expected `object \| null`, got `array`"),
        ('{"points": ' + "[" * 100_000 + "]" * 100_000 + "}", "cannot be read"),
    ],
)
def test_bad_documents(parse: Parse, document: str, match: str) -> None:
    """Everything that is wrong is refused with the key and the row."""
    with pytest.raises(MalformedFileError, match=match):
        parse(document.encode())


def test_missing_values(parse: Parse) -> None:
    """null, NaN and Infinity are missing values in points, normals and scalars alike."""
    cloud = parse(
        b'{"points": [[0, 0, null], [1, NaN, 2]], "normals": [[0, 0, 1], [null, 0, 1]],'
        b' "scalars": {"depth": [ -Infinity , 0.5], "a, NaN ]": [1, 2]}}'
    )
    np.testing.assert_array_equal(cloud.points, [[0, 0, np.nan], [1, np.nan, 2]])
    assert cloud.normals is not None
    assert np.isnan(cloud.normals[1, 0])
    np.testing.assert_array_equal(cloud.scalars["depth"], [np.nan, 0.5])


def test_colors_of_16_bits(parse: Parse, dump: Dump) -> None:
    """Whole numbers above 255 are colours of 16 bits, and stay so when written and read."""
    cloud = parse(b'{"points": [[0,0,0],[1,1,1]], "colors": [[0, 256, 65535], [1, 2, 3]]}')
    assert cloud.colors is not None
    assert cloud.colors.dtype == np.uint16
    back = parse(dump(cloud, "json"))
    np.testing.assert_array_equal(back.colors, cloud.colors)


def test_not_utf8(parse: Parse) -> None:
    """Bytes that are no UTF-8 are a malformed file, not an exception of the decoder."""
    with pytest.raises(MalformedFileError):
        parse(b'{"points": [[0,0,0]], "scalars": {"\xff\xfe": [1]}}')


def test_rows_are_counted_before_decoding(parse: Parse) -> None:
    """The limit of points holds for each key, and is checked before rows become objects."""
    two = '{"points": [[0,0,0],[1,1,1]]'
    assert len(parse((two + "}").encode(), max_points=2)) == 2
    extras = ["", ', "normals": [[],[],[]]', ', "scalars": {"a": [1,2,3]}']
    for extra, limit in zip(extras, (1, 2, 2), strict=True):
        with pytest.raises(LimitExceededError) as caught:
            parse((two + extra + "}").encode(), max_points=limit)
        assert caught.value.fields["name"] == "max_points"


def test_too_many_scalars(parse: Parse) -> None:
    """The number of scalars is bounded."""
    scalars = {f"s{index}": [0] for index in range(300)}
    with pytest.raises(MalformedFileError, match="300 keys"):
        parse(json.dumps({"points": [[0, 0, 0]], "scalars": scalars}).encode())


def test_others_read_ours(rich: Cloud, dump: Dump) -> None:
    """Python's own decoder reads what we write, to the same numbers."""
    document = json.loads(dump(rich, "json"))
    assert list(document) == ["points", "normals", "colors", "scalars"]
    np.testing.assert_array_equal(np.float32(document["points"]), rich.points)
    np.testing.assert_array_equal(document["scalars"]["time"], rich.scalars["time"])
    assert document["scalars"]["class"] == list(range(7))


def test_round_trip_in_blocks(parse: Parse, dump: Dump) -> None:
    """More rows than one block come back exactly, NaN in scalars as well."""
    rng = np.random.default_rng(0)
    depth = rng.random(40_000)
    depth[17] = np.nan
    half = rng.random(40_000).astype(np.float16)
    cloud = Cloud(
        rng.normal(size=(40_000, 3)) * 1e6,
        rng.random((40_000, 3)).astype(np.float32),
        rng.integers(0, 256, (40_000, 3)).astype(np.uint8),
        {"depth": depth, 'quote"\n': half, "flag": depth > 0.5, "id": np.arange(40_000)},
    )
    back = parse(dump(cloud, "json"))
    np.testing.assert_array_equal(back.points, cloud.points)
    assert back.normals is not None
    np.testing.assert_array_equal(back.normals, cloud.normals)
    assert back.colors is not None
    np.testing.assert_array_equal(back.colors, cloud.colors)
    for name, values in cloud.scalars.items():
        np.testing.assert_array_equal(back.scalars[name].astype(values.dtype), values)
    assert back.scalars["flag"].dtype == np.bool_


def test_empty_round_trip(parse: Parse, dump: Dump) -> None:
    """A cloud of no points is valid JSON too."""
    assert len(parse(dump(Cloud(np.empty((0, 3)), scalars={"a": np.empty(0)}), "json"))) == 0
