# SPDX-License-Identifier: Apache-2.0
"""NumPy archives and arrays, honest and hostile."""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud, LimitExceededError, MalformedFileError
from pugeo_model.formats import npz, read, write

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]


def archive(compressed: bool = False, **arrays: Any) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


def array(values: NDArray[Any], **options: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values, **options)
    return buffer.getvalue()


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return buffer.getvalue()


def declaring(shape: str, dtype: str = "<f8") -> bytes:
    """Build the header of an array without its data."""
    text = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


P = np.arange(12, dtype=np.float64).reshape(4, 3)


@pytest.mark.parametrize("compressed", [False, True])
def test_archive(parse: Parse, compressed: bool) -> None:
    """Points, normals, colours and scalars are found by name; the rest is dropped with a note."""
    cloud = parse(
        archive(
            compressed,
            points=P.astype(np.float32),
            normals=P,
            colors=np.full((4, 3), 0.5),
            label=np.arange(4),
            mask=np.ones(4, bool),
            faces=np.zeros((2, 3), int),
            words=np.array(["a", "b", "c", "d"]),
        )
    )
    np.testing.assert_array_equal(cloud.points, P)
    assert cloud.points.dtype == np.float32
    assert cloud.normals is not None
    assert cloud.normals.dtype == np.float32
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[128] * 3] * 4
    assert list(cloud.scalars) == ["label", "mask"]
    assert len(cloud.notes) == 2
    assert "'faces'" in cloud.notes[0]


@pytest.mark.parametrize("dtype", ["i4", "u2", "i8", ">f8", "f8", "f4", ">f4", "f2"])
def test_single_array(parse: Parse, dtype: str) -> None:
    """Whole numbers become doubles; floats stay, in this machine's byte order."""
    cloud = parse(array(P.astype(dtype)))
    np.testing.assert_array_equal(cloud.points, P)
    assert cloud.points.dtype == (np.float32 if dtype[-2:] in ("f4", "f2") else np.float64)
    assert cloud.points.dtype.isnative


def test_columns_order_and_normals(parse: Parse) -> None:
    """Six columns are points and unit normals, in either memory order and npy version."""
    six = np.random.default_rng(0).random((5, 6))
    six[:, 3:] /= np.linalg.norm(six[:, 3:], axis=1, keepdims=True)
    six = np.asfortranarray(six)
    cloud = parse(array(six))
    np.testing.assert_array_equal(cloud.points, six[:, :3])
    assert cloud.normals is not None
    np.testing.assert_array_equal(cloud.normals, six[:, 3:].astype(np.float32))
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, P, version=(2, 0))
    np.testing.assert_array_equal(parse(buffer.getvalue()).points, P)


@pytest.mark.parametrize("shape", [(4, 2), (12,), (4, 3, 1), (), (3, 257), (0,)])
def test_single_array_of_wrong_shape(parse: Parse, shape: tuple[int, ...]) -> None:
    """Any other shape is refused with those that are right."""
    with pytest.raises(MalformedFileError, match=r"\(M, 3\), or have up to"):
        parse(array(np.zeros(shape)))


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"xyz": P}, "no array 'points'.*holds xyz"),
        ({"points": P[:, :2]}, r"'points' must be numeric of shape \(4, 3\)"),
        ({"points": np.float64(1)}, "'points' must be"),
        ({"points": P, "normals": P[:3]}, r"'normals' must be numeric of shape \(4, 3\)"),
        ({"points": P, "colors": P[:, :2]}, r"'colors' must be .* \(4, 3\) or \(4, 4\)"),
        ({"points": P.astype(complex)}, "'points' must be numeric"),
        ({"points": P.astype(str)}, "'points' must be numeric"),
        ({"points": P.astype(object)}, "holds Python objects"),
        ({"points": P, "extra": np.array([{}] * 4)}, "holds Python objects"),
    ],
)
def test_bad_archives(parse: Parse, arrays: dict[str, Any], match: str) -> None:
    """Wrong keys, shapes and types are refused by name; nothing is ever unpickled."""
    with pytest.raises(MalformedFileError, match=match):
        parse(archive(**arrays))


def test_zip_bomb(parse: Parse) -> None:
    """Unpacked sizes are checked before unpacking, for each array and in total."""
    bomb = archive(compressed=True, points=np.zeros((1_000_000, 3)))
    assert len(bomb) < 200_000
    with pytest.raises(LimitExceededError) as caught:
        parse(bomb, max_bytes=1_000_000)
    assert caught.value.fields["name"] == "max_bytes"
    with pytest.raises(LimitExceededError) as caught:
        parse(bomb, max_points=999_999)
    assert caught.value.fields["name"] == "max_points"
    many = {f"s{index}": np.zeros(1000) for index in range(20)}
    with pytest.raises(LimitExceededError):
        parse(archive(compressed=True, points=np.zeros((1000, 3)), **many), max_bytes=100_000)


@pytest.mark.parametrize("shape", ["(20000000, 3)", "(1000000, 3)"])
def test_declared_but_absent(parse: Parse, shape: str) -> None:
    """An array whose data are missing is refused before it is allocated."""
    for data in (declaring(shape), zipped({"points.npy": declaring(shape)})):
        with pytest.raises(MalformedFileError) as caught:
            parse(data)
        assert caught.value.code == "truncated"


@pytest.mark.parametrize("shape", ["(4000000000, 3)", "(10**30, 3)", "(-1, 3)", "(True,)", "7"])
@pytest.mark.parametrize("dtype", ["<f8", "|S0", "|a5", "|V0", "|O", "nonsense", "f8,f8"])
def test_hostile_headers(parse: Parse, shape: str, dtype: str) -> None:
    """Impossible shapes and types are refused, none with another exception."""
    shape = shape.replace("10**30", "1" + "0" * 30)
    for data in (declaring(shape, dtype), zipped({"points.npy": declaring(shape, dtype)})):
        with pytest.raises((MalformedFileError, LimitExceededError)):
            parse(data)


def test_other_zips(parse: Parse) -> None:
    """A zip that holds no arrays, is cut off, encrypted or lies about itself is refused."""
    good = archive(points=P)
    flipped = bytearray(archive(compressed=True, points=np.random.default_rng(0).random((99, 3))))
    flipped[200] ^= 0xFF
    locked = bytearray(good)
    locked[6] |= 1
    locked[good.index(b"PK\x01\x02") + 8] |= 1
    method = good.replace(b"PK\x01\x02", b"PK\x01\x02", 1)
    at = method.index(b"PK\x01\x02") + 10
    method = method[:at] + b"\x63" + method[at + 1 :]
    for data in (
        zipped({"readme.txt": b"hello"}),
        zipped({}),
        good[:-30],
        good[: len(good) // 2],
        b"PK\x03\x04",
        bytes(flipped),
        bytes(locked),
        method,
    ):
        with pytest.raises(MalformedFileError):
            parse(data if data.startswith(b"PK\x03\x04") else b"PK\x03\x04" + data)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions(parse: Parse, method: int) -> None:
    """Methods that numpy does not write are refused whole or damaged: LZMA's errors are its own."""
    good = zipped({"points.npy": array(P)}, method)
    damaged = bytearray(good)
    damaged[60] ^= 0xFF
    for data in (good, bytes(damaged)):
        with pytest.raises(MalformedFileError, match="is compressed by method"):
            parse(data)


def test_same_name_twice(parse: Parse) -> None:
    """Two arrays of one name are refused: which one is meant is not guessed."""
    with pytest.raises(MalformedFileError, match="'points' is in the archive twice"):
        parse(zipped({"points.npy": array(P), "points": array(P)}))


def test_huge_directory(parse: Parse) -> None:
    """An archive with thousands of entries is refused before its directory is read."""
    data = zipped({f"member{index}": b"" for index in range(2_000)}, zipfile.ZIP_STORED)
    with pytest.raises(LimitExceededError) as caught:
        parse(data)
    assert caught.value.fields["name"] == "max_header_bytes"


def test_zip64_directory(parse: Parse) -> None:
    """The record by which a small archive could announce a huge directory is refused."""
    data = archive(points=P)
    end = data.rindex(b"PK\x05\x06")
    with pytest.raises(LimitExceededError):
        parse(data[:end] + b"PK\x06\x07" + bytes(16) + data[end:])


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the headers that were parsed."""
    sizes: list[int] = []

    def counting(parse: Callable[..., Any]) -> Callable[..., Any]:
        def count(file: io.BytesIO) -> Any:
            sizes.append(file.getbuffer().nbytes)
            return parse(file)

        return count

    headers = {key: (width, counting(parse)) for key, (width, parse) in npz._HEADERS.items()}
    monkeypatch.setattr(npz, "_HEADERS", headers)
    return sizes


def test_headers_are_bounded_together(parse: Parse, parsed: list[int]) -> None:
    """A thousand long headers in a small archive are refused once some of them are parsed."""
    long = declaring(f"({'1, ' * 60}{' ' * 9_700})")
    data = zipped({"points.npy": array(P)} | {f"{index:x}": long for index in range(1_100)})
    assert len(data) < 250_000
    with pytest.raises(LimitExceededError) as caught:
        parse(data)
    assert caught.value.fields["name"] == "max_header_bytes"
    assert 0 < sum(parsed) < 70_000


def test_many_scalars_are_read(parse: Parse, dump: Dump) -> None:
    """A thousand scalars with headers of the usual size are no attack."""
    scalars = {f"s{index}": np.array([index]) for index in range(1_000)}
    back = parse(dump(Cloud(np.zeros((1, 3)), scalars=scalars), "npz"))
    assert list(back.scalars) == list(scalars)


def test_axes_are_bounded(parse: Parse, parsed: list[int]) -> None:
    """A shape of more axes than NumPy allows is refused, before it is parsed where it can be."""
    for data in (declaring(f"({'1,' * 3_000})"), declaring(f"({'1,' * 66})")):
        for each in (data, zipped({"points.npy": array(P), "extra.npy": data})):
            parsed.clear()
            with pytest.raises(MalformedFileError, match="axes"):
                parse(each)
            assert max(parsed, default=0) < 200
    hidden = declaring(f"({'1,' * 65})").replace(b"'shape'", b"'sh''ape'")
    hidden = hidden[:8] + struct.pack("<H", len(hidden) - 10) + hidden[10:]
    with pytest.raises(MalformedFileError, match="axes"):
        parse(zipped({"points.npy": array(P), "extra.npy": hidden}))


def test_an_extent_beyond_64_bits(parse: Parse) -> None:
    """An extent that Python would not even print is refused, also of an array without a meaning."""
    huge = declaring(f"(0x{'f' * 5_000},)")
    with pytest.raises(MalformedFileError, match="too large"):
        parse(zipped({"points.npy": array(P), "extra.npy": huge}))


def test_notes_are_few_and_short(parse: Parse) -> None:
    """Hundreds of arrays without a meaning give some notes, with shapes and names cut short."""
    odd = declaring(f"({'1, ' * 64})") + bytes(8)
    names = ["x" * 2_000, *(f"n{index}" for index in range(300))]
    notes = parse(zipped({"points.npy": array(P)} | dict.fromkeys(names, odd))).notes
    assert len(notes) == 50
    assert max(len(note) for note in notes) <= 500
    assert notes[-1] == "252 more notes are left out."
    assert "1,...) is dropped: a scalar would be" in notes[1]


def test_numpy_reads_ours(rich: Cloud, dump: Dump) -> None:
    """NumPy reads our archives, and the same cloud gives the same bytes."""
    data = dump(rich, "npz")
    assert dump(rich, "npz") == data
    with np.load(io.BytesIO(data)) as loaded:
        assert set(loaded) == {"points", "normals", "colors", *rich.scalars}
        np.testing.assert_array_equal(loaded["time"], rich.scalars["time"])


def test_scalar_names(parse: Parse, dump: Dump) -> None:
    """Scalars that are called like our arrays, or like a path, do not hurt the archive."""
    names = ["points", "normals", "file", "../up", "a\x00b", ""]
    scalars = {name: np.array([index]) for index, name in enumerate(names)}
    back = parse(dump(Cloud(np.zeros((1, 3)), scalars=scalars), "npz"))
    assert [int(each[0]) for each in back.scalars.values()] == list(range(len(names)))


def test_an_array_is_written_as_an_array(tmp_path: Path) -> None:
    """A path that ends in .npy gets one array, points beside normals, that numpy loads."""
    cloud = Cloud(P, normals=np.ones_like(P, dtype=np.float32))
    write(cloud, tmp_path / "cloud.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "cloud.npy")[:, :3], P)
    np.testing.assert_array_equal(read(tmp_path / "cloud.npy").points, P)
