# SPDX-License-Identifier: Apache-2.0
"""Valid files of every format and dialect that the readers know, made in code.

What a fuzzer reaches depends on what it starts from: a mutation of a text file never becomes a
binary file with lists.
"""

import functools
import io
import itertools
import json
import zipfile
from collections.abc import Callable, Iterator

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from benchmarks.reliability import corpus_scans
from pugeo_model import Cloud, formats

__all__ = ["corpus", "pack"]

_ROWS = 9
# Longer than the blocks that readers work in, so that seams between blocks are met as well.
_MANY = 60_000


@functools.cache
def corpus() -> dict[str, list[bytes]]:
    """Files by the name of their format."""
    return {
        "ply": [*_binary_plys(), *_text_plys()],
        "npy": list(_npys()),
        "npz": list(_npzs()),
        "json": list(_jsons()),
        "xyz": list(_texts()),
        "las": list(corpus_scans.lases(_cloud(), _bare(_MANY // 4))),
        "laz": list(corpus_scans.lazes(_cloud(), _bare(_MANY // 4))),
        "pcd": list(corpus_scans.pcds(_cloud(), _bare(_MANY))),
        "ptx": list(corpus_scans.ptxs(_cloud(), _bare(_MANY // 4))),
        "obj": list(corpus_scans.objs(_cloud(), _bare(_MANY))),
        "stl": list(corpus_scans.stls(_cloud(), _bare(_MANY))),
        "e57": list(corpus_scans.e57s(_cloud())),
    }


def _bare(rows: int) -> Cloud:
    return Cloud(_cloud(rows).points)


def pack(members: dict[str, bytes], method: int) -> bytes:
    """A zip archive of these members, with right checksums and sizes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return buffer.getvalue()


def _cloud(rows: int = _ROWS, exact: bool = False) -> Cloud:
    rng = np.random.default_rng(rows)
    return Cloud(
        points=rng.normal(size=(rows, 3)).astype(np.float64 if exact else np.float32),
        normals=rng.normal(size=(rows, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (rows, 4)).astype(np.uint8),
        scalars={
            "intensity": rng.random(rows).astype(np.float32),
            "time": rng.random(rows) * 1e9,
            "class": np.arange(rows).astype(np.uint8),
        },
    )


def _written(cloud: Cloud, name: str) -> bytes:
    buffer = io.BytesIO()
    formats.write(cloud, buffer, format=name)
    return buffer.getvalue()


def _ply(kind: str, elements: str, body: bytes, newline: str = "\n") -> bytes:
    lines = f"ply;format {kind} 1.0;comment made for tests;{elements};end_header;"
    return lines.replace(";", newline).encode() + body


def _binary_plys() -> Iterator[bytes]:
    yield _written(_cloud(), "ply")
    yield _written(_cloud(exact=True), "ply")
    yield _written(Cloud(_cloud().points), "ply")
    yield _written(Cloud(_cloud(_MANY).points), "ply")
    for order, kind in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        xyz = "property float x;property float y;property float z"
        rows = np.arange(3 * _ROWS, dtype=f"{order}f4").reshape(_ROWS, 3)
        faces = b"".join(
            bytes([3]) + np.array([i, i + 1, i + 2], f"{order}i4").tobytes()
            for i in range(_ROWS - 2)
        )
        mesh = f"element vertex {_ROWS};{xyz};element face {_ROWS - 2};"
        yield _ply(kind, f"{mesh}property list uchar int vertex_indices", rows.tobytes() + faces)
        # An element before the vertices, and lists of one length within them.
        alike = b"".join(row.tobytes() + bytes([2, 7, 8]) for row in rows)
        yield _ply(
            kind,
            f"obj_info 1;element camera 2;property double f;element vertex {_ROWS};{xyz};"
            "property list uchar uchar views",
            np.ones(2, f"{order}f8").tobytes() + alike,
        )
        # Lists whose lengths differ, two in a row.
        ragged = b"".join(
            row.tobytes()
            + np.array([i % 4], f"{order}i2").tobytes()
            + np.arange(i % 4, dtype=f"{order}f8").tobytes()
            + bytes([i % 3, *range(i % 3)])
            for i, row in enumerate(rows)
        )
        lists = "property list short double a;property list uint8 int8 b"
        yield _ply(kind, f"element vertex {_ROWS};{xyz};{lists}", ragged)
        before = f"element face {_ROWS - 2};property list uchar int vertex_indices;"
        yield _ply(kind, f"{before}element vertex {_ROWS};{xyz}", faces + rows.tobytes())
        columns = "xyz", ("red", "green", "blue", "alpha"), ("normal_x", "normal_y", "normal_z")
        wide = [("f8", columns[0]), ("u2", columns[1]), ("f4", columns[2])]
        names = {"f8": "float64", "u2": "ushort", "f4": "float32"}
        properties = [f"property {names[t]} {n}" for t, group in wide for n in group]
        row_type = np.dtype([(n, order + t) for t, group in wide for n in group])
        table = np.zeros(_ROWS, row_type)
        yield _ply(kind, f"element vertex {_ROWS};{';'.join(properties)}", table.tobytes())
    splat = "".join(f";property float {n}" for n in ("x", "y", "z", "f_dc_0", "opacity", "rot_0"))
    yield _ply("binary_little_endian", f"element vertex {_ROWS}{splat}", bytes(24 * _ROWS))


def _text_plys() -> Iterator[bytes]:
    yield _written(_cloud(), "ply-ascii")
    yield _written(Cloud(_cloud(_MANY // 3).points), "ply-ascii")
    xyz = "property float x;property float y;property double z"
    rows = [f"{i} {i * i} -{i}.5e-3" for i in range(_ROWS)]
    for newline in ("\n", "\r\n", "\r"):
        body = newline.join([*rows, ""]).encode()
        yield _ply("ascii", f"element vertex {_ROWS};{xyz}", body, newline)
    faces = [f"3 {i} {i + 1} {i + 2}" for i in range(4)]
    lists = "property list uchar int vertex_indices"
    yield _ply(
        "ascii",
        f"element vertex {_ROWS};{xyz};element face 4;{lists}",
        "\n".join([*rows, *faces, ""]).encode(),
    )
    yield _ply(
        "ascii",
        f"element face 4;{lists};element vertex {_ROWS};{xyz};property list uchar char views;"
        "property uchar red;property uchar green;property uchar blue;property int64 label",
        "\n".join([*faces, *(f"{row} 2 5 6 1 2 3 -9" for row in rows), ""]).encode(),
    )


def _array(values: NDArray[np.generic], version: tuple[int, int] = (1, 0)) -> bytes:
    buffer = io.BytesIO()
    npy.write_array(buffer, values, version=version, allow_pickle=False)
    return buffer.getvalue()


def _npys() -> Iterator[bytes]:
    rows = np.arange(6 * _ROWS, dtype=np.float64).reshape(_ROWS, 6)
    for kind in ("<f4", ">f8", "<f2", "<i4", "u1"):
        yield _array(rows[:, :3].astype(kind))
    yield _array(rows)
    yield _array(np.asfortranarray(rows[:, :3]))
    yield _array(rows[:, :3], (2, 0))
    yield _array(np.zeros((_MANY, 3), np.float32))


def _npzs() -> Iterator[bytes]:
    cloud = _cloud()
    members = {"points.npy": _array(cloud.points)}
    yield pack(members, zipfile.ZIP_STORED)
    yield pack({"points.npy": _array(np.zeros((_MANY, 3), np.float32))}, zipfile.ZIP_DEFLATED)
    assert cloud.normals is not None
    assert cloud.colors is not None
    members |= {
        "normals.npy": _array(cloud.normals),
        "colors.npy": _array(cloud.colors),
        "class.npy": _array(cloud.scalars["class"]),
        "name.npy": _array(np.array("scan")),
        "pose.npy": _array(np.eye(4)),
    }
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        yield pack(members, method)
    yield _written(cloud, "npz")


def _jsons() -> Iterator[bytes]:
    yield _written(_cloud(), "json")
    yield _written(Cloud(_cloud(_MANY // 6).points), "json")
    rows = [[i, 2 * i, -0.5e-3 * i] for i in range(_ROWS)]
    yield json.dumps({"points": rows}).encode()
    yield json.dumps({"points": rows, "normals": rows, "colors": None, "scalars": None}).encode()
    yield json.dumps(
        {
            "points": rows,
            "colors": [[0.1, 0.2, 1.0, 0.5]] * _ROWS,
            "scalars": {"mask": [True] * _ROWS, "gap": [None, 1.5] * 4 + [2], "id": [1] * _ROWS},
        },
        indent=2,
    ).encode("utf-8-sig")


def _texts() -> Iterator[bytes]:
    yield _written(_cloud(), "xyz")
    yield _written(Cloud(_cloud(_MANY // 4).points), "xyz")
    rows = [[f"{i}.5", f"-{i}", f"{i}e-2"] for i in range(_ROWS)]
    joined: Callable[[str, str], bytes] = lambda blank, end: "".join(  # noqa: E731 - used twice
        blank.join(row) + end for row in rows
    ).encode()
    for blank, end in itertools.product((" ", ",", ";\t"), ("\n", "\r\n", "\r")):
        yield joined(blank, end)
    yield f"{_ROWS}\n".encode() + joined(" ", " 12 1 2 255\n")
    yield b"// x y z Red Green Blue label\n" + joined(" ", " 10 20 30 4 # remark\n")
    yield b"x,y,z,nx,ny,nz\n" + joined(",", ",0,0,1\n")
    yield b'"","Easting","Northing","Elevation","Rf","Gf","Bf"\n' + joined(",", ",0.1,0.2,0.3\n")
    yield joined(",", ",,1\n") + joined(",", ",2,\n")
    yield ("\ufeffx;y;z;Illuminance (PCV)\r\n" + "1;2;3;0.5\r\n" * _ROWS).encode("utf-16")
    yield b"#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n" + (
        b"1 0.5 0.25 0.125 1 2 3 0.5 1 2 3 4\n2 1.5 0.25 0.125 1 2 3 0.5 1 2\n" * _ROWS
    )
