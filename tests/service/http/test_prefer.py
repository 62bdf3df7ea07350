# SPDX-License-Identifier: Apache-2.0
"""Preferences are read as RFC 7240 writes them, and what is not understood is left out."""

import pytest
from starlette.datastructures import Headers

from pugeo_service.http.prefer import Preferences, preferences


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], Preferences()),
        (["wait=30"], Preferences(wait=30)),
        (['Wait = "30" ; foo=1'], Preferences(wait=30)),
        (["respond-async, wait=10"], Preferences(respond_async=True, wait=10)),
        (["respond-async", "wait=10"], Preferences(respond_async=True, wait=10)),
        (["wait=5, wait=9"], Preferences(wait=5)),
        (["handling=lenient"], Preferences()),
        (["wait=0"], Preferences()),
        (["wait=-1"], Preferences()),
        (["wait=1.5"], Preferences()),
        (["wait=\u0665"], Preferences()),
        (["wait=" + "9" * 5000], Preferences()),
        (["wait"], Preferences()),
        ([",,=,;"], Preferences()),
    ],
)
def test_preferences(values: list[str], expected: Preferences) -> None:
    """Several headers are one list, names have no case, the first of a kind counts."""
    raw = [(b"prefer", value.encode("utf-8")) for value in values]
    assert preferences(Headers(raw=raw)) == expected
