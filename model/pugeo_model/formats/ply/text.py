# SPDX-License-Identifier: Apache-2.0
"""PLY rows as text."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.numbers import NumberLines, Rows
from pugeo_model.formats.ply.header import Element

__all__ = ["read_rows"]

# Text is parsed as float64, which holds whole numbers up to here.
_EXACT = 2**53


def read_rows(lines: NumberLines, element: Element, sinks: Mapping[str, NDArray[Any]]) -> None:
    """Read the rows of one element, one line each, into ``sinks``.

    Args:
        lines: at the element's first line; left after its last one.
        element: the properties of a line, and the number of lines.
        sinks: property name -> ``(element.count,)`` array. Empty: the lines are passed over.

    Raises:
        MalformedFileError: too few lines, a line with too many or too few values, something that is
            no number, a number that its declared type cannot hold.
    """
    if not element.properties:
        return
    done = 0 if sinks else lines.skip(element.count)
    while done < element.count:
        rows = lines.take(element.count - done)
        if rows is None:
            break
        for name, values in _columns(element, rows, sinks).items():
            sinks[name][done : done + len(rows)] = values
        done += len(rows)
    if done < element.count:
        raise MalformedFileError(
            f"The file ends too early: expected {element.count:,} rows of {element.name!r}, "
            f"found {done:,}.",
            code="truncated",
            expected_rows=element.count,
            found_rows=done,
        )


def _columns(
    element: Element, rows: Rows, wanted: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    places = rows.starts[:-1].copy()
    ends = rows.starts[1:]
    columns: dict[str, NDArray[Any]] = {}
    for each in element.properties:
        _check_rows(places >= ends, rows, "has too few values")
        values = rows.values[places]
        places += 1
        if each.count_type is not None:
            _check_type(values, each.count_type, rows, each.name)
            _check_rows((values < 0) | (values > ends - places), rows, "has too few values")
            places += values.astype(np.int64)
        elif each.name in wanted:
            if each.type[0] != "f":
                _check_type(values, each.type, rows, each.name)
            with np.errstate(over="ignore"):
                columns[each.name] = values.astype(each.type)
    _check_rows(places < ends, rows, "has too many values")
    return columns


def _check_type(values: NDArray[np.float64], kind: str, rows: Rows, name: str) -> None:
    bounds = np.iinfo(kind)
    low, high = max(bounds.min, -_EXACT), min(bounds.max, _EXACT)
    good = (values >= low) & (values <= high) & (values == np.rint(values))
    _check_rows(~good, rows, f"has a value of {name!r} that is no whole number in its range")


def _check_rows(bad: NDArray[np.bool_], rows: Rows, what: str) -> None:
    if bad.any():
        line = int(rows.lines[np.argmax(bad)])
        raise MalformedFileError(f"Line {line} {what}.", code="bad_row", line=line)
