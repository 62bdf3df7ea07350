# SPDX-License-Identifier: Apache-2.0
"""Bodies of jobs whose size is known to be too large are refused at once."""

import io
from typing import Any

import numpy as np
import pytest

from pugeo_model.cloud import Cloud
from pugeo_model.formats import write


def body(format: str) -> bytes:
    """A cloud of 100 points with a scalar."""
    buffer = io.BytesIO()
    scalars = {"a": np.linspace(0, 1, 100)}
    write(
        Cloud(np.random.default_rng(0).normal(size=(100, 3)), scalars=scalars),
        buffer,
        format=format,
    )
    return buffer.getvalue()


@pytest.mark.parametrize("format", ["ply", "npz", "npy", "pcd", "las", "laz"])
@pytest.mark.parametrize(
    ("setting", "limit"),
    [
        ("max_points", 99),
        ("max_cloud_bytes", 1000),
        ("max_output_points", 399),
        ("max_output_bytes", 4000),
    ],
)
def test_a_header_refuses_a_job(play: Any, format: str, setting: str, limit: int) -> None:
    """A job that can be known too large by the header of its body gets 413, and leaves nothing."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post("/jobs?R=4", content=body(format))
        problem = answer.json()
        assert (answer.status_code, problem["limit"]) == (413, limit)
        assert problem["setting"] == f"PUGEO_{setting.upper()}"
        assert problem["setting"] in problem["detail"]
        assert house.names("inputs") == []
        assert (await house.http.get("/jobs")).json()["jobs"] == []

    play(scenario, **{setting: limit})


def test_other_faults_are_those_of_the_job(play: Any) -> None:
    """A body that is no cloud, or a text, is accepted: only its reading shows what it is."""

    async def scenario(house: Any) -> None:
        for content in (b"cloud", b"0 0 0\n" * 99, body("ply")[:50]):
            assert (await house.http.post("/jobs", content=content)).status_code == 202

    play(scenario, max_points=9)


def test_more_than_all_jobs_may_have(play: Any) -> None:
    """A body that exceeds the whole capacity gets 413 before it is read, and not 503 for ever."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post("/jobs", content=b"x" * 101)
        assert (answer.status_code, answer.json()["setting"]) == (413, "PUGEO_JOBS_BYTES")
        assert house.names("inputs") == []

    play(scenario, jobs_bytes=100)
