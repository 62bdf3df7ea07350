# SPDX-License-Identifier: Apache-2.0
"""Choice of the output format by ``?format=`` and ``Accept``."""

import pytest

from pugeo_model.formats import WRITABLE
from pugeo_service.http.negotiation import DEFAULT, OUTPUT_FORMATS, choose_format, negotiate
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
    """Weights decide, then specificity, then order; wildcards mean binary PLY."""
    assert choose_format(accept, None).name == expected


@pytest.mark.parametrize("name", list(WRITABLE))
def test_every_format_of_the_model_is_offered(name: str) -> None:
    """Each format of the model is chosen by its name and by its media type."""
    assert choose_format(None, name).name == name
    assert choose_format(WRITABLE[name].MEDIA_TYPES[0], None).name == name


def test_the_query_wins() -> None:
    """The query has priority over the header."""
    assert choose_format("application/json", "npz").name == "npz"


def test_wildcards_mean_what_the_route_prefers() -> None:
    """Wildcards mean the given default."""
    assert choose_format("*/*", None, OUTPUT_FORMATS["json"]).name == "json"
    assert DEFAULT.name == "ply"


def test_json_in_means_json_out() -> None:
    """The default is JSON for a JSON body, and binary PLY otherwise."""
    assert negotiate({"content-type": "application/json; charset=utf-8"}, None).name == "json"
    assert negotiate({"content-type": "application/json"}, "xyz").name == "xyz"
    assert negotiate({}, None).name == "ply"


@pytest.mark.parametrize("accept", ["image/png", "application/json;q=0", "text/html"])
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
