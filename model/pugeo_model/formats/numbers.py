# SPDX-License-Identifier: Apache-2.0
"""Lines of numbers, read many at a time.

``np.loadtxt`` takes 10 s for a million rows. Here numpy finds the lines and counts their tokens
byte-wise, and parses a whole block at once, so that the cost for each row is that of its digits,
and a row with a value too many or too few is still known by its line number.
"""

import re
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import LimitExceededError, MalformedFileError
from pugeo_model.formats.stream import CHUNK_BYTES

__all__ = ["NumberLines", "Rows"]

_MAX_LINE_BYTES = 1 << 22
_COMMENT = re.compile(rb"(?:#|//)[^\n\r]*")
# A cell without a value: between two separators, before the first one or after the last one.
_BLANK_CELL = re.compile(rb"(?:(?<=[,;])|(?<![^\n\r]))[ \t]*(?=[,;])|(?<=[,;])[ \t]*(?=[\r\n])")


@dataclass(frozen=True)
class Rows:
    """Some consecutive lines that hold numbers.

    Attributes:
        values: ``(T,)`` float64, all numbers in reading order.
        starts: ``(n + 1,)`` int64, row ``i`` is ``values[starts[i]:starts[i + 1]]``, never empty.
        lines: ``(n,)`` int64, line number of each row in the file, from 1.
    """

    values: NDArray[np.float64]
    starts: NDArray[np.int64]
    lines: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.lines)


class NumberLines:
    """Read rows of numbers from a text file.

    Args:
        file: binary file, at the start of a line.
        line: number of that line, from 1, for messages.
        translate: 256-byte table applied to the text, such as one that turns commas into blanks.
        comments: whether ``#`` and ``//`` start a comment.
        blank_cells: whether a cell without a value, as in ``1,,3``, is a missing value (NaN).
    """

    def __init__(
        self,
        file: IO[bytes],
        *,
        line: int = 1,
        translate: bytes | None = None,
        comments: bool = False,
        blank_cells: bool = False,
    ) -> None:
        self._file = file
        self._line = line
        self._translate = translate
        self._comments = comments
        self._blank_cells = blank_cells
        self._rest = b""  # whole lines, ready to be parsed
        self._line_start = b""  # of the line that the last chunk ended in, as it is in the file
        self._ended = False

    def take(self, count: int) -> Rows | None:
        """Read up to ``count`` rows; fewer where a block ends, ``None`` at the end of the file.

        Raises:
            MalformedFileError: something is not a number, with its line.
            LimitExceededError: a line longer than 4 MiB.
        """
        block = self._next(count)
        if block is None:
            return None
        text, starts, lines = block
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            values = np.empty(0)
        if len(values) != starts[-1]:
            # Also met where numpy stopped early, or read "1-2" as two numbers.
            raise _not_a_number(text, int(lines[0]))
        return Rows(values, starts, lines)

    def skip(self, count: int) -> int:
        """Pass over up to ``count`` rows unread; returns how many there were."""
        passed = 0
        while passed < count:
            block = self._next(count - passed)
            if block is None:
                break
            passed += len(block[2])
        return passed

    def __bool__(self) -> bool:
        """True if anything but blank lines is left."""
        return self._fill()

    def _fill(self) -> bool:
        """Hold at least one whole line with a token, or return False at the end."""
        while not self._rest.strip():
            self._line += self._rest.count(b"\n")
            self._rest = b""
            if self._ended:
                return False
            if len(self._line_start) > _MAX_LINE_BYTES:
                raise LimitExceededError(
                    f"Line {self._line} is longer than {_MAX_LINE_BYTES:,} bytes.",
                    name="max_line_bytes",
                    limit=_MAX_LINE_BYTES,
                    value=len(self._line_start),
                )
            chunk = self._file.read(CHUNK_BYTES)
            if not chunk:
                self._ended = True
                chunk = b"\n"
            text = self._line_start + chunk
            cut = max(text.rfind(b"\n"), text.rfind(b"\r") if self._bare_returns else -1) + 1
            self._rest, self._line_start = self._plain(text[:cut]), text[cut:]
        return True

    @property
    def _bare_returns(self) -> bool:
        """True if a carriage return alone ends a line."""
        return self._translate is not None and self._translate[13] == 10

    def _plain(self, lines: bytes) -> bytes:
        """Whole lines without comments, with blank cells filled and separators translated."""
        if self._comments and (b"#" in lines or b"/" in lines):
            lines = _COMMENT.sub(b"", lines)
        if self._blank_cells and (b"," in lines or b";" in lines):
            lines = _BLANK_CELL.sub(b"nan", lines)
        return lines if self._translate is None else lines.translate(self._translate)

    def _next(self, count: int) -> tuple[bytes, NDArray[np.int64], NDArray[np.int64]] | None:
        """Cut up to ``count`` rows off the buffer: their text, token starts and line numbers."""
        if count <= 0 or not self._fill():
            return None
        whole = self._rest
        data = np.frombuffer(whole, np.uint8)
        # Blank is what it is to bytes.split: space and 9 to 13. Unsigned numbers wrap around.
        blank = (data == 32) | (data - np.uint8(9) <= 4)
        first = ~blank
        first[1:] &= blank[:-1]
        ends = np.flatnonzero(data == 10)
        tokens = np.cumsum(first, dtype=np.int64)[ends]
        filled = np.flatnonzero(np.diff(tokens, prepend=0))[:count]
        cut = int(ends[filled[-1]]) + 1
        starts = np.concatenate([np.zeros(1, np.int64), tokens[filled]])
        lines = self._line + filled
        self._line += int(filled[-1]) + 1
        self._rest = self._rest[cut:]
        return whole[:cut], starts, lines


def _not_a_number(text: bytes, line: int) -> MalformedFileError:
    """Find the first token that is no number (``line``: where the first row of the text is)."""
    rows = text.split(b"\n")
    while rows and not rows[0].strip():
        del rows[0]
    for offset, row in enumerate(rows):
        for token in row.split():
            try:
                float(token)
                plain = b"_" not in token
            except ValueError:
                plain = False
            if not plain:
                shown = token[:40].decode("latin-1")
                return MalformedFileError(
                    f"Line {line + offset}: {shown!r} is not a number.",
                    code="not_a_number",
                    line=line + offset,
                )
    return MalformedFileError(
        f"Something from line {line} on is not a plain number.", code="not_a_number", line=line
    )
