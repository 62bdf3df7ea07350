# SPDX-License-Identifier: Apache-2.0
"""docs/paper.md: every table and figure with command, seconds, budget and the printed numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence

from pugeo_model.reproduce.printed import PRINTED_COLUMNS
from pugeo_model.reproduce.tables import Line

__all__ = ["figures_table", "lines_table", "section"]

_DECIMALS = {"CD": 4, "CD#": 4}


def section(title: str, command: str, seconds: float, *parts: str) -> str:
    """One table or figure with the command that makes it and the seconds that it took."""
    took = f"`{command}`, {seconds:,.0f} seconds of one core."
    return "\n\n".join([f"## {title}", took, *(part for part in parts if part)]) + "\n"


def lines_table(lines: Iterable[Line], columns: Sequence[str] = PRINTED_COLUMNS) -> str:
    """Markdown of a table's lines; each cell is ours, then the paper's number in brackets.

    Args:
        lines: of the table.
        columns: which to show, a subset of ``PRINTED_COLUMNS``.
    """
    rows = [
        ["R", "method", *columns, "normals °", "size MB", "budget", "upsampling s"],
        ["---:", "---", *["---:"] * len(columns), "---:", "---:", "---", "---:"],
    ]
    notes: list[str] = []
    for line in lines:
        cells = [_cell(line, name, columns) for name in columns]
        size = _pair(line.megabytes, line.printed_megabytes, 1)
        angle = seconds = ""
        if line.row is not None:
            angle = _number(line.row.columns.get("normal_mean"), 2)
            # Points that another line has made take no time.
            seconds = "" if line.row.seconds < 1 else _number(line.row.seconds, 0)
        budget = line.budget or (line.why and "none, see below")
        rows.append([str(line.ratio), line.method, *cells, angle, size, budget, seconds])
        if line.why:
            notes.append(f"- {line.method}, R={line.ratio}: {line.why}")
        elif line.command and not any(f"`{line.command}`" in note for note in notes):
            notes.append(f"- {line.method}, R={line.ratio}: `{line.command}`")
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return "\n\n".join(part for part in (table, "\n".join(notes)) if part)


def _cell(line: Line, name: str, columns: Sequence[str]) -> str:
    decimals = _DECIMALS.get(name, 3)
    ours = None if line.row is None else line.row.columns.get(name)
    theirs = None
    if line.printed is not None:
        # Table 2 prints its three columns alone.
        of = PRINTED_COLUMNS if len(line.printed) == len(PRINTED_COLUMNS) else columns
        theirs = dict(zip(of, line.printed, strict=True))[name]
    return _pair(ours, theirs, decimals)


def _pair(ours: float | None, theirs: float | None, decimals: int) -> str:
    printed = "" if theirs is None else f" ({theirs:g})"
    return f"{_number(ours, decimals)}{printed}".strip()


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{decimals}f}"


def figures_table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown of named numbers, a line for each name; columns are those of the first line."""
    columns = list(next(iter(rows.values())))
    lines = [["", *columns], ["---", *["---:"] * len(columns)]]
    lines += [
        [name, *(_number(figures.get(column), 3) for column in columns)]
        for name, figures in rows.items()
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
