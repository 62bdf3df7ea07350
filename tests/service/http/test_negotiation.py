# SPDX-License-Identifier: Apache-2.0
"""The answer's format follows ``?format=``, then ``Accept``."""

import pytest

from pugeo_model.formats import FORMATS
from pugeo_service.http.negotiation import DEFAULT, OFFERS, choose
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
    """Weights decide, then precision, then order; zero refuses; wildcards mean binary PLY."""
    assert choose(accept, None).name == expected


@pytest.mark.parametrize("name", list(FORMATS))
def test_every_format_of_the_model_is_offered(name: str) -> None:
    """A format added to the model is offered by name and by its own media type."""
    assert choose(None, name).name == name
    assert choose(FORMATS[name].MEDIA_TYPES[0], None).name == name


def test_the_query_wins() -> None:
    """Links cannot set headers, so what they can set counts more."""
    assert choose("application/json", "npz").name == "npz"


def test_wildcards_mean_what_the_route_prefers() -> None:
    """JSON in means JSON out for whoever takes anything."""
    assert choose("*/*", None, OFFERS["json"]).name == "json"
    assert DEFAULT.name == "ply"


@pytest.mark.parametrize("accept", ["image/png", "application/json;q=0", "text/html"])
def test_nothing_suits(accept: str) -> None:
    """406 lists what would do."""
    with pytest.raises(ProblemError) as caught:
        choose(accept, None)
    assert caught.value.status == 406
    assert "application/json" in caught.value.fields["offers"]
    assert caught.value.headers["Vary"] == "Accept"


def test_an_unknown_format() -> None:
    """422 names the parameter, its value and what is allowed."""
    with pytest.raises(ProblemError) as caught:
        choose(None, "las")
    assert caught.value.status == 422
    assert caught.value.fields == {
        "parameter": "format",
        "value": "las",
        "allowed": list(OFFERS),
    }
