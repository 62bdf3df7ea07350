# SPDX-License-Identifier: Apache-2.0
"""Layout of a text file of points: encoding, names of columns, count, first row."""

import codecs
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.meaning import standard_name
from pugeo_model.formats.stream import CHUNK_BYTES

__all__ = ["Layout", "as_utf8", "find_layout", "plain_head"]

_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SPOOL_BYTES = 1 << 24
_MOST_LINES = 200  # before the first row
_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_LINE = re.compile(r"[^\r\n]*(\r\n?|\n|$)")
_QUOTED_CELL = re.compile(r'\s*(?:"([^"]*)"|\'([^\']*)\')\s*')
_TRACKS = "POINT3D_ID, X, Y, Z, R, G, B, ERROR"


@dataclass(frozen=True)
class Layout:
    """Facts about a text file that stand before its first row.

    Attributes:
        names: of the columns as written (``""``: a column without a name), or ``None``.
        counted: whether the next line is a count of points.
        passed: bytes before that line, or before the first row.
        lines: lines in them.
        bare_returns: whether a carriage return alone ends a line.
        ragged: whether rows go on after the named columns (tracks of COLMAP).
        table: whether cells are separated by commas or semicolons, so that some can be blank.
    """

    names: list[str] | None
    counted: bool
    passed: int
    lines: int
    bare_returns: bool
    ragged: bool
    table: bool


def plain_head(head: bytes) -> str:
    """Decode the beginning of a text file: UTF-8 or UTF-16 with a byte order mark, else Latin-1."""
    if head.startswith(_UTF16):
        return head[: len(head) // 2 * 2].decode("utf-16", "replace")
    # One character a byte, so that positions are those of the file.
    return head.removeprefix(codecs.BOM_UTF8).decode("latin-1")


@contextmanager
def as_utf8(file: IO[bytes], limits: Limits) -> Iterator[IO[bytes]]:
    """Give a file without a byte order mark, at its first character; UTF-16 is transcoded."""
    start = file.tell()
    mark = file.read(3)
    if mark[:2] not in _UTF16:
        file.seek(start + 3 * (mark == codecs.BOM_UTF8))
        yield file
        return
    file.seek(start)
    decoder = codecs.getincrementaldecoder("utf-16")()
    with tempfile.SpooledTemporaryFile(max_size=_SPOOL_BYTES) as spool:
        size = 0
        try:
            while chunk := file.read(CHUNK_BYTES):
                data = decoder.decode(chunk).encode()
                size += len(data)
                limits.check("max_bytes", size, "Bytes of the text")
                spool.write(data)
            decoder.decode(b"", final=True)
        except UnicodeError as error:
            raise MalformedFileError(
                f"The text begins as UTF-16 but is not: {error}.", code="not_a_number"
            ) from error
        spool.seek(0)
        yield spool


def find_layout(head: str) -> Layout | None:
    """Find names, count and first row; ``None`` where the text is no table of points.

    Args:
        head: some thousand characters from the beginning of the file.

    Raises:
        MalformedFileError: a line of names that does not fit the rows.
    """
    comments: list[str] = []
    title: str | None = None
    counted, passed, lines, place = False, 0, 0, 0
    first: str | None = None
    while place < len(head) and lines < _MOST_LINES:
        line = _LINE.match(head, place)
        assert line is not None
        text = line[0].strip()
        place, number = line.end(), lines
        lines += 1
        if text.startswith(("#", "//")):
            comments.append(text.lstrip("#/ \t"))
            continue
        if not text:
            continue
        cells = _words(text)
        numeric = [bool(_NUMBER.fullmatch(cell)) for cell in cells if cell]
        if len(cells) == 1 and all(numeric) and not counted:
            counted, passed, lines_before_count = True, line.start(), number
            continue
        if len(numeric) >= 3 and all(numeric):
            first = text
            if not counted:
                passed, lines_before_count = line.start(), number
            break
        if title is not None or counted or not _has_points(_cells(text)):
            return None
        title = text
    if first is None and title is None and not counted:
        return None
    if first is None and not counted:
        passed, lines_before_count = place, lines
    names, ragged = _names(title, comments, first)
    bare = "\r" in head and "\n" not in head
    table = first is not None and bool(re.search("[,;]", first))
    return Layout(names, counted, passed, lines_before_count, bare, ragged, table)


def _names(
    title: str | None, comments: list[str], first: str | None
) -> tuple[list[str] | None, bool]:
    """Names of the columns, and whether rows go on after them."""
    width = None if first is None else len(_row_cells(first))
    if title is not None:
        names = _fitted(_cells(title), width)
        if names is None:
            raise MalformedFileError(
                f"The first line names {len(_cells(title))} columns, one of them twice, or the "
                "rows have another number of them.",
                code="bad_header",
            )
        return names, False
    for comment in reversed(comments):
        if comment.startswith(_TRACKS):
            return _cells(_TRACKS), True
        cells = _cells(comment)
        if _has_points(cells) and (names := _fitted(cells, width)) is not None:
            return names, False
    return None, False


def _fitted(cells: list[str], width: int | None) -> list[str] | None:
    """Join words that are one name, until there are as many names as columns."""
    names: list[str] = []
    for cell in cells:
        if names and re.match(r"[(\[]", cell):
            names[-1] += f" {cell}"
        else:
            names.append(cell)
    if width is not None and len(names) > width > 3:
        # A last name with blanks, such as "Scalar field 2".
        names[width - 1 :] = [" ".join(names[width - 1 :])]
    known = [name for name in names if name]
    if len(set(known)) < len(known) or width not in (None, len(names)):
        return None
    return names


def _has_points(cells: list[str]) -> bool:
    found = {standard_name(cell) for cell in cells}
    return {"x", "y", "z"} <= found


def _cells(text: str) -> list[str]:
    """Split a line of names at its separator; quotes go."""
    text = text.encode("latin-1", "replace").decode("utf-8", "replace")
    for separator in (";", ",", "\t"):
        if separator in text:
            cells = text.split(separator)
            while cells and not cells[-1].strip():
                cells.pop()
            return [_unquoted(cell) for cell in cells]
    return [_unquoted(cell) for cell in text.split()]


def _unquoted(cell: str) -> str:
    quoted = _QUOTED_CELL.fullmatch(cell)
    return (quoted[1] or quoted[2] or "" if quoted else cell).strip()


def _row_cells(text: str) -> list[str]:
    """Split a row as the parser will: blank cells count, blanks around separators do not."""
    text = re.split(r"#|//", text)[0].strip(" \t")
    if re.search("[,;]", text):
        cells = re.sub(r"[ \t]*([,;])[ \t]*", r"\1", text)
        return re.split(r"[,;]|[ \t]+", cells)
    return text.split()


def _words(text: str) -> list[str]:
    return [cell.strip('"') for cell in _row_cells(text)]
