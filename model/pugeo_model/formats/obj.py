# SPDX-License-Identifier: Apache-2.0
"""Wavefront OBJ: its vertices as points. Only read."""

import re
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import LimitExceededError, MalformedFileError
from pugeo_model.formats.colors import to_channels
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.stream import CHUNK_BYTES

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "read", "sniff"]

NAME = "obj"
EXTENSIONS: tuple[str, ...] = (".obj",)
MEDIA_TYPES: tuple[str, ...] = ("model/obj",)

_MAX_LINE_BYTES = 1 << 22
_START = re.compile(
    rb"(?:[ \t]*(?:#[^\r\n]*|(?:mtllib|o|g|s|usemtl)[ \t][^\r\n]*)?[\r\n]+)*v[ \t]+[-+.\d]"
)
_VERTEX = re.compile(rb"^[ \t]*v[ \t]([^\r\n]*)", re.MULTILINE)
_NORMAL = re.compile(rb"^[ \t]*vn[ \t]([^\r\n]*)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is an OBJ file."""
    return _START.match(head.removeprefix(b"\xef\xbb\xbf")) is not None


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read the vertices ``v x y z [r g b]``, and the normals ``vn`` if there are as many.

    Args:
        file: at the first byte.
        limits: ``max_points`` bounds vertices and normals.

    Raises:
        MalformedFileError: no vertices, a vertex that is not 3, 4 or 6 numbers.
        LimitExceededError: more vertices than ``limits``, or a line longer than 4 MiB.
    """
    vertices: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    count = turned = faces = 0
    rest = b""
    while True:
        chunk = file.read(CHUNK_BYTES)
        text = rest + (chunk or b"\n")
        cut = max(text.rfind(b"\n"), text.rfind(b"\r")) + 1
        whole, rest = text[:cut], text[cut:]
        if len(rest) > _MAX_LINE_BYTES:
            raise LimitExceededError(
                f"A line of the OBJ file is longer than {_MAX_LINE_BYTES:,} bytes.",
                name="max_line_bytes",
                limit=_MAX_LINE_BYTES,
                value=len(rest),
            )
        whole = whole.replace(b"\r", b"\n") if b"\r" in whole else whole
        found, more = _VERTEX.findall(whole), _NORMAL.findall(whole)
        count, turned = count + len(found), turned + len(more)
        limits.check("max_points", max(count, turned), "Vertices of the OBJ file, at least")
        faces += len(_FACE.findall(whole))
        if found:
            vertices.append(_table(found))
        if more:
            normals.append(_table(more))
        if not chunk:
            break
    if not vertices:
        raise MalformedFileError("The OBJ file has no vertices ('v').", code="missing_property")
    return _cloud(vertices, normals, faces)


def _table(lines: list[bytes]) -> NDArray[np.float64]:
    """Numbers of some lines, all of one length."""
    widths = {len(line.split(b"#")[0].split()) for line in lines}
    if len(widths) != 1 or not widths <= {3, 4, 6, 7}:
        raise MalformedFileError(
            f"OBJ vertices have {', '.join(map(str, sorted(widths)))} numbers; 3, 4 or 6 are "
            "read, all lines the same.",
            code="bad_row",
        )
    tokens = b" ".join(line.split(b"#")[0] for line in lines).split()
    try:
        values = np.array(tokens).astype(np.float64)
    except ValueError as error:
        raise MalformedFileError(
            f"A vertex of the OBJ file is no number: {str(error)[:80]}.", code="not_a_number"
        ) from error
    return values.reshape(len(lines), -1)


def _cloud(
    vertices: list[NDArray[np.float64]], normals: list[NDArray[np.float64]], faces: int
) -> Cloud:
    width = min(block.shape[1] for block in vertices)
    if any(block.shape[1] != width for block in vertices):
        raise MalformedFileError("OBJ vertices have different lengths.", code="bad_row")
    table = np.concatenate(vertices)
    notes: list[str] = []
    colors: NDArray[Any] | None = None
    if width >= 6:
        colors, note = to_channels(table[:, -3:])
        notes += [note] if note else []
    given: NDArray[np.float32] | None = None
    if normals:
        turned = np.concatenate([block[:, :3] for block in normals])
        if len(turned) == len(table):
            with np.errstate(over="ignore", invalid="ignore"):
                given = turned.astype(np.float32)
        else:
            notes.append(
                f"The normals are dropped: there are {len(turned):,} for {len(table):,} vertices."
            )
    if faces:
        notes.append(
            f"The file is a mesh: its {faces:,} faces are dropped, and its corners alone are "
            "taken as the scan."
        )
    points = np.ascontiguousarray(table[:, :3])
    return Cloud(points, given, colors, {}, tuple(notes), source=SourceInfo("obj"))
