# SPDX-License-Identifier: Apache-2.0
"""Bounds on the notes about a file."""

from pugeo_model.formats.limits import bounded_notes, shortened


def test_a_text_is_cut() -> None:
    """A text of the size allowed stays; a longer one has that size with its dots."""
    assert shortened("12345", 5) == "12345"
    assert shortened("123456", 5) == "12..."


def test_few_notes_stay() -> None:
    """As many notes as are allowed stay as they are."""
    notes = tuple(f"Note {index}." for index in range(50))
    assert bounded_notes(notes) == notes


def test_many_notes_are_counted() -> None:
    """The last note says how many are left out, also after a second time."""
    notes = [f"{index} {'x' * 10_000}" for index in range(2_000)]
    found = bounded_notes(iter(notes))
    assert len(found) == 50
    assert found[48].startswith("48 x")
    assert found[-1] == "1,951 more notes are left out."
    assert max(map(len, found)) == 500
    assert bounded_notes(found) == found
