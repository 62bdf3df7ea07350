# SPDX-License-Identifier: Apache-2.0
"""Choice of the output format by ``?format=`` and ``Accept``."""

import pytest

from pugeo_model.formats import FORMATS, WRITABLE
from pugeo_service.http.negotiation import OUTPUT_FORMATS, choose_format
from pugeo_service.problems import ProblemError


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, "ply"),
        ("", "ply"),
        ("*/*", "ply"),
        ("application/octet-stream", "ply"),
        ("application/json", "json"),
        ("application/x-npz", "npz"),
        ("text/plain", "xyz"),
        ("application/x-ply", "ply"),
        ("application/ply; format=ascii", "ply-ascii"),
        ('model/ply;format="ascii"', "ply-ascii"),
        ("application/json;q=0.5, application/x-npz", "npz"),
        ("application/json;q=0.9, application/x-npz;q=0.8", "json"),
        ("application/json;q=0, */*;q=0.1", "ply"),
        ("text/html, application/xhtml+xml, */*;q=0.8", "ply"),
        ("*/*, application/json", "json"),
        ("APPLICATION/JSON", "json"),
        ("application/json;q=nonsense, application/x-npz;q=0.1", "npz"),
    ],
)
def test_accept(accept: str | None, expected: str) -> None:
    """Weights decide, then specificity, then order; wildcards mean the input's format, PLY here."""
    assert choose_format(accept, None).for_input("ply").name == expected


@pytest.mark.parametrize("name", list(WRITABLE))
def test_every_format_of_the_model_is_offered(name: str) -> None:
    """Each format of the model is chosen by its name and by its media type."""
    assert choose_format(None, name).for_input("xyz").name == name
    assert choose_format(WRITABLE[name].MEDIA_TYPES[0], None).for_input("xyz").name == name


def test_the_query_wins() -> None:
    """The query has priority over the header."""
    assert choose_format("application/json", "npz").for_input("ply").name == "npz"


@pytest.mark.parametrize("accept", [None, "", "*/*", "application/octet-stream", "text/html, */*"])
@pytest.mark.parametrize("read_as", list(FORMATS))
def test_the_format_of_the_input(accept: str | None, read_as: str) -> None:
    """Without a named format the answer has that of the input, or PLY if it cannot be written."""
    expected = read_as if read_as in WRITABLE else "ply"
    assert choose_format(accept, None).for_input(read_as).name == expected


def test_an_input_that_is_not_recognised() -> None:
    """The answer to an input of no known format would be PLY; the reader then refuses it."""
    assert choose_format(None, None).for_input(None).name == "ply"


@pytest.mark.parametrize(
    ("accept", "read_as", "expected"),
    [
        ("application/*", "laz", "laz"),
        ("application/*", "xyz", "ply"),
        ("model/*", "e57", "e57"),
        ("model/*", "laz", "ply"),
        ("text/*", "ply-ascii", "ply-ascii"),
        ("text/*", "laz", "xyz"),
    ],
)
def test_a_range_that_the_input_may_not_suit(accept: str, read_as: str, expected: str) -> None:
    """A wildcard of one type means the input's format if that has a media type within it."""
    assert choose_format(accept, None).for_input(read_as).name == expected


@pytest.mark.parametrize(
    ("accept", "read_as", "expected"),
    [
        ("application/x-ply;q=0, */*", "ply", "xyz"),
        ("*/*, application/x-ply;q=0", "ply", "xyz"),
        ("application/x-ply;q=0.0, */*;q=0.1", "ply", "xyz"),
        ("application/x-ply;q=0, */*", "laz", "laz"),
        ("application/x-ply;q=0, */*", "stl", "xyz"),
        ("application/x-ply;q=0, application/ply, */*;q=0.1", "laz", "ply"),
        ("application/json;q=0, application/octet-stream", "json", "ply"),
        ("application/octet-stream;q=0, */*", "npz", "npz"),
        ("text/plain;q=0, text/*", "xyz", "ply-ascii"),
        ("application/*;q=0, */*", "ply", "xyz"),
        ("application/*;q=0, application/json, */*;q=0.1", "ply", "json"),
        ("model/*;q=0, */*", "e57", "ply"),
        ("model/*;q=0, */*", "ply", "ply"),
        ("*/*;q=0, application/x-npz", "ply", "npz"),
        ("application/json;q=0.1, */*", "json", "ply"),
    ],
)
def test_the_most_specific_range_decides(accept: str, read_as: str, expected: str) -> None:
    """A weight of 0 excludes a media type, also where a wildcard of more weight matches it."""
    assert choose_format(accept, None).for_input(read_as).name == expected


@pytest.mark.parametrize(
    "accept",
    [
        "image/png",
        "application/json;q=0",
        "text/html",
        "*/*;q=0",
        "text/plain;q=0, text/csv;q=0, text/ply;q=0, text/x-ply;q=0, text/*",
        "application/octet-stream;q=0",
    ],
)
def test_nothing_suits(accept: str) -> None:
    """406 lists all formats."""
    with pytest.raises(ProblemError) as caught:
        choose_format(accept, None)
    assert caught.value.status == 406
    assert "application/json" in caught.value.fields["offers"]
    assert caught.value.headers["Vary"] == "Accept"


def test_an_unknown_format() -> None:
    """422 names the parameter, its value and the allowed ones."""
    with pytest.raises(ProblemError) as caught:
        choose_format(None, "docx")
    assert caught.value.status == 422
    assert caught.value.fields == {
        "parameter": "format",
        "value": "docx",
        "allowed": list(OUTPUT_FORMATS),
    }
