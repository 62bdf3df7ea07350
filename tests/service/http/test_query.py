# SPDX-License-Identifier: Apache-2.0
"""The query of /upsample: all options with their ranges."""

from typing import Any

import pytest
from pydantic import ValidationError

from pugeo_model.errors import BadOptionError
from pugeo_model.options import Options
from pugeo_service.http.query import UpsampleQuery


def test_defaults_are_the_models() -> None:
    """The defaults are those of the model."""
    assert Options(**UpsampleQuery().for_model()) == Options()


def test_everything_reaches_the_model() -> None:
    """Each option is passed to the model under its name there."""
    query = UpsampleQuery(R=2.5, orient="viewpoint", viewpoint="1,-2,3e1", seed=7)
    assert Options(**query.for_model()) == Options(
        ratio=2.5, orient="viewpoint", viewpoint=((1.0, -2.0, 30.0),), seed=7
    )
    assert Options(**UpsampleQuery(n_points=9).for_model()) == Options(n_points=9)


@pytest.mark.parametrize(
    "query",
    [
        {"R": "0"},
        {"R": "0.999"},
        {"R": "33"},
        {"R": "1e9"},
        {"R": "nan"},
        {"R": "inf"},
        {"R": "abc"},
        {"R": ""},
        {"n_points": "0"},
        {"n_points": "2.5"},
        {"R": "2", "n_points": "10"},
        {"R": "2", "spacing": "0.1"},
        {"n_points": "10", "spacing": "0.1"},
        {"spacing": "0"},
        {"max_gap": "inf"},
        {"density": "dense"},
        {"seed": "-1"},
        {"seed": str(2**63)},
        {"viewpoint": "1,2"},
        {"viewpoint": "1,2,x"},
        {"viewpoint": "1,2,inf"},
        {"r": "4"},
        {"ratio": "4"},
    ],
)
def test_what_is_out_of_range(query: dict[str, Any]) -> None:
    """A value out of its range is refused."""
    with pytest.raises(ValidationError):
        UpsampleQuery(**query)


@pytest.mark.parametrize("query", [{}, {"R": "4"}, {"spacing": "0.1"}, {"n_points": "9"}])
def test_denoising_needs_the_ratio_1(query: dict[str, Any]) -> None:
    """Denoising with any other size, the default one too, is refused as on the command line."""
    with pytest.raises(BadOptionError, match="ratio 1"):
        Options(**UpsampleQuery(denoise=True, **query).for_model())
    assert Options(**UpsampleQuery(denoise=True, R=1).for_model()).denoise
