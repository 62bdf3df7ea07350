# SPDX-License-Identifier: Apache-2.0
"""Headers that describe a run."""

import json
from typing import Any

import pytest

from pugeo_service.http.negotiation import OutputFormat
from pugeo_service.http.responses import run_headers

MODEL = {"name": "standard", "version": "1", "sha256": "ab"}


def notes_header(notes: list[str]) -> str:
    """The header of a run with these notes."""
    report: dict[str, Any] = {
        "points_in": 1,
        "points_out": 2,
        "dropped": {"non_finite": 0, "duplicate": 0},
        "notes": notes,
    }
    output = OutputFormat("ply", ("application/x-ply",), "ply")
    return run_headers(report, {}, output, MODEL)["Pugeo-Notes"]


@pytest.mark.parametrize("notes", [[], ["One."], ["One.", "Zw\u00f6lf \u65e5\u672c.", '"Quoted".']])
def test_notes_are_json(notes: list[str]) -> None:
    """Few notes are a JSON array in ASCII, as `json.dumps` writes it."""
    assert notes_header(notes) == json.dumps(notes)


def test_notes_end_at_the_limit() -> None:
    """As many notes as fit are sent: another character would be too much."""
    first = "x" * 1000
    room = 2048 - len(json.dumps([first, ""]))
    assert json.loads(notes_header([first, "y" * room, "z"])) == [first, "y" * room]
    assert json.loads(notes_header([first, "y" * (room + 1)])) == [first]
    assert notes_header(["\u65e5" * 400]) == "[]"


def test_the_cost_of_notes_is_that_of_the_header(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a thousand long notes only those that may fit are encoded, each once."""
    encoded: list[int] = []
    dumps = json.dumps

    def counted(value: Any) -> str:
        text = dumps(value)
        encoded.append(len(text))
        return text

    monkeypatch.setattr(json, "dumps", counted)
    assert len(json.loads(notes_header(["x" * 100] * 1000))) == 19
    assert len(encoded) <= 20
    assert sum(encoded) < 4096
    encoded.clear()
    assert notes_header(["x" * 15_000] * 1000) == "[]"
    assert encoded == []
