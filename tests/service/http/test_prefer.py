# SPDX-License-Identifier: Apache-2.0
"""The Prefer header as in RFC 7240; unknown and malformed preferences are ignored."""

import pytest
from starlette.datastructures import Headers

from pugeo_service.http.prefer import preferred_wait


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], None),
        (["wait=30"], 30),
        (['Wait = "30" ; foo=1'], 30),
        (["respond-async, wait=10"], None),
        (["respond-async", "wait=10"], None),
        (["wait=5, wait=9"], 5),
        (["handling=lenient"], None),
        (["wait=0"], None),
        (["wait=-1"], None),
        (["wait=1.5"], None),
        (["wait=\u0665"], None),
        (["wait=" + "9" * 5000], None),
        (["wait"], None),
        ([",,=,;"], None),
    ],
)
def test_preferred_wait(values: list[str], expected: int | None) -> None:
    """Several headers form one list, names ignore case, the first of a kind counts."""
    raw = [(b"prefer", value.encode("utf-8")) for value in values]
    assert preferred_wait(Headers(raw=raw)) == expected
