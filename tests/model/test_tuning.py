# SPDX-License-Identifier: Apache-2.0
"""Constants of the method."""

from dataclasses import fields
from pathlib import Path

import pytest

from pugeo_model.tuning import TUNING, Tuning, table


@pytest.mark.parametrize("field", fields(Tuning), ids=lambda field: field.name)
def test_each_constant_is_documented(field) -> None:
    """A constant has a unit, a reason, and a range that contains its value."""
    low, high = field.metadata["range"]
    value = getattr(TUNING, field.name)
    assert low < high
    assert all(low <= each <= high for each in (value if isinstance(value, tuple) else (value,)))
    assert field.metadata["unit"]
    assert len(field.metadata["reason"].split()) > 4


def test_the_page_has_the_table_of_the_code(root: Path) -> None:
    """docs/reference/tuning.md contains the table that ``python -m pugeo_model.tuning`` prints."""
    assert table() in (root / "docs/reference/tuning.md").read_text("utf-8")


def test_each_constant_is_used(root: Path) -> None:
    """No constant stands in the table without a use in the model."""
    sources = [
        path.read_text("utf-8")
        for path in (root / "model/pugeo_model").rglob("*.py")
        if path.name != "tuning.py"
    ]
    used = "\n".join(sources)
    assert [each.name for each in fields(Tuning) if f"TUNING.{each.name}" not in used] == []
