# SPDX-License-Identifier: Apache-2.0
"""Valid files of the formats of scanners and meshes, made in code by us and by other programs."""

import io
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pye57
from numpy.typing import NDArray

from pugeo_model import Cloud, formats

__all__ = ["e57s", "lases", "lazes", "lzf_packed", "objs", "pcds", "ptxs", "stls"]


def _written(cloud: Cloud, name: str) -> bytes:
    buffer = io.BytesIO()
    formats.write(cloud, buffer, format=name)
    return buffer.getvalue()


def _las(version: str, kind: int, rows: int, *, compress: bool) -> bytes:
    """A file that laspy writes, with an extra dimension and a record of its own."""
    rng = np.random.default_rng(kind)
    header = laspy.LasHeader(version=version, point_format=kind)
    header.scales, header.offsets = np.full(3, 1e-3), np.array([5e5, 4e6, 0.0])
    header.add_extra_dims([laspy.ExtraBytesParams("height", "f4")])
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", b'PROJCS["none"]\0'))
    las = laspy.LasData(header)
    las.x, las.y, las.z = rng.normal(size=(3, rows)) + [[5e5], [4e6], [0.0]]
    las.intensity = rng.integers(0, 65536, rows).astype(np.uint16)
    las.classification = rng.integers(0, 20, rows).astype(np.uint8)
    las.height = rng.random(rows).astype(np.float32)
    if "red" in las.point_format.dimension_names:
        las.red = las.green = las.blue = rng.integers(0, 65536, rows).astype(np.uint16)
    buffer = io.BytesIO()
    las.write(buffer, do_compress=compress)
    return buffer.getvalue()


def lases(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """All point formats without waveforms, and ours."""
    for version, kind in (("1.2", 0), ("1.2", 3), ("1.3", 1), ("1.4", 6), ("1.4", 7), ("1.4", 8)):
        yield _las(version, kind, len(cloud), compress=False)
    yield _written(cloud, "las")
    yield _written(many, "las")


def lazes(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """As `lases`, compressed."""
    for version, kind in (("1.2", 0), ("1.2", 3), ("1.3", 1), ("1.4", 6), ("1.4", 7), ("1.4", 8)):
        yield _las(version, kind, len(cloud), compress=True)
    yield _written(cloud, "laz")
    yield _written(many, "laz")


def lzf_packed(data: bytes) -> bytes:
    """Compress by LZF, with runs of one byte as the only references back."""
    packed = bytearray()
    place = 0
    while place < len(data):
        run = 1
        while place + run < len(data) and run < 265 and data[place + run] == data[place]:
            run += 1
        packed += bytes([0, data[place]])
        place += 1
        if run > 3:
            length = run - 1 - 2
            packed += bytes([length << 5, 0] if length < 7 else [7 << 5, length - 7, 0])
            place += run - 1
    return bytes(packed)


def pcds(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """All three encodings, packed and repeated fields, padding, an organised cloud."""
    yield _written(cloud, "pcd")
    yield _written(many, "pcd")
    count = len(cloud)
    rows = np.zeros(count, "<f4,<f4,<f4,V4,<u4,<f4,(3,)<f4,<i2")
    for index, values in enumerate(cloud.points.T):
        rows[f"f{index}"] = values
    rows["f4"], rows["f6"], rows["f7"] = 0x00102030, 0.5, np.arange(count)
    head = (
        "# .PCD v.7\nVERSION .7\nFIELDS x y z _ rgba i hist label\nSIZE 4 4 4 1 4 4 4 2\n"
        f"TYPE F F F U U F F I\nCOUNT 1 1 1 4 1 1 3 1\nWIDTH {count // 3}\nHEIGHT 3\n"
        f"VIEWPOINT 1 2 3 1 0 0 0\nPOINTS {count}\nDATA "
    ).encode()
    yield head + b"binary\n" + rows.tobytes()
    columns = b"".join(
        np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ()
    )
    packed = lzf_packed(columns)
    yield head + b"binary_compressed\n" + struct.pack("<II", len(packed), len(columns)) + packed
    text = "".join(
        f"{x:g} {y:g} nan 1 2 3 4 1056816 0.5 1 2 3 {i}\n"
        for i, (x, y, _) in enumerate(cloud.points)
    )
    yield head + b"ascii\n" + text.encode()


def ptxs(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """Two scans with poses and empty cells, with colours and without; ours."""
    yield _written(cloud, "ptx")
    yield _written(many, "ptx")
    pose = "1 2 3\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n1 2 3 1\n"
    cells = [f"{x:g} {y:g} {z:g} 0.5" for x, y, z in cloud.points[:6]] + ["0 0 0 0.5"] * 2
    for more, end in (("", "\n"), (" 1 2 255", "\r\n")):
        scan = f"4\n2\n{pose}" + "".join(f"{cell}{more}\n" for cell in cells)
        yield (scan * 2).replace("\n", end).encode()


def objs(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """With colours, normals, faces and remarks; a large one."""
    rows = [" ".join(f"{value:g}" for value in row) for row in cloud.points]
    yield (
        "# made\no one\n" + "".join(f"v {row}\n" for row in rows) + "f 1 2 3\nf 1/2/3 2//1 3\n"
    ).encode()
    yield "".join(f"v {row} 0.1 0.2 1\nvn 0 0 1\nvt 0 1\n" for row in rows).encode()
    yield "".join(f"v {row[0]:g} {row[1]:g} {row[2]:g}\n" for row in many.points[:20_000]).encode()


def stls(cloud: Cloud, many: Cloud) -> Iterator[bytes]:
    """Binary and text; a large one."""
    corner = "vertex {:g} {:g} {:g}\n"
    text = "solid made\n"
    for x, y, z in cloud.points:
        loop = corner.format(x, y, z) + corner.format(0, 1, 0) + corner.format(1, 0, 0)
        text += f"facet normal 0 0 1\nouter loop\n{loop}endloop\nendfacet\n"
    yield text.encode() + b"endsolid made\n"
    for points in (cloud.points, many.points[:5000]):
        yield _binary_stl(points.astype("<f4"))


def _binary_stl(points: NDArray[np.float32]) -> bytes:
    rows = np.zeros(
        len(points), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]
    )
    rows["corners"][:, 0], rows["corners"][:, 1] = points, [[0, 1, 0]]
    return b"made".ljust(80) + struct.pack("<I", len(points)) + rows.tobytes()


def e57s(cloud: Cloud) -> Iterator[bytes]:
    """One scan of ours; two of pye57 with poses, invalid points, rows and columns."""
    yield _written(cloud, "e57")
    count = len(cloud)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.e57"
        with pye57.E57(str(path), mode="w") as file:
            for number in range(2):
                file.write_scan_raw(
                    {
                        "cartesianX": cloud.points[:, 0].astype(np.float64),
                        "cartesianY": cloud.points[:, 1].astype(np.float64),
                        "cartesianZ": cloud.points[:, 2].astype(np.float64),
                        "intensity": np.linspace(0, 1, count, dtype=np.float32),
                        "rowIndex": np.arange(count, dtype=np.uint16),
                        "columnIndex": np.arange(count, dtype=np.uint16),
                        "cartesianInvalidState": (np.arange(count) % 3 == 0).astype(np.int8),
                    },
                    rotation=np.array([0.8, 0.0, 0.6, 0.0]),
                    translation=np.array([5e5, 4e6, float(number)]),
                )
        yield path.read_bytes()
