# SPDX-License-Identifier: Apache-2.0
"""Bounds on the size of an answer, asked before the work."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.service.engine.standard import STANDARD

from pugeo_model.cloud import Cloud
from pugeo_model.errors import LimitExceededError
from pugeo_model.formats import Declared
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_service.engine import stages
from pugeo_service.engine.answer_size import check_answer, check_plan
from pugeo_service.runs import make_run_request
from pugeo_service.settings import Settings

REQUEST = make_run_request(
    Settings(engine="inline"),
    {"ratio": 8.0},
    model=STANDARD,
    format=None,
    answer="ply",
    deadline_s=9.0,
)


def archive(columns: int, points: int = 2000) -> np.ndarray:
    """A small archive of a large cloud: constant columns deflate to nothing."""
    buffer = io.BytesIO()
    scalars: dict[str, Any] = {f"s{i}": np.full(points, 0.5) for i in range(columns)}
    np.savez_compressed(buffer, points=np.zeros((points, 3)), **scalars)
    return np.frombuffer(buffer.getvalue(), np.uint8)


@pytest.fixture(autouse=True)
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if anything is unpacked or computed."""

    def fail(*_: object, **__: object) -> None:
        raise AssertionError("the work began")

    monkeypatch.setattr(stages, "load_model", fail)
    monkeypatch.setattr("pugeo_model.formats.npz._read_archive", fail)


def test_columns_are_counted_in_the_answer() -> None:
    """A small body with a thousand columns is refused by the bytes of its answer."""
    request = replace(REQUEST, max_output_bytes=100_000_000)
    with pytest.raises(LimitExceededError) as caught:
        stages.prepare(archive(1000), request)
    fields = {"name": "max_output_bytes", "limit": 100_000_000, "value": 16_000 * 8036}
    assert (caught.value.code, caught.value.fields) == ("too_many_output_bytes", fields)


def test_columns_are_counted_in_the_input() -> None:
    """It is refused by the bytes that it unpacks to as well."""
    with pytest.raises(LimitExceededError) as caught:
        stages.prepare(archive(1000), replace(REQUEST, max_cloud_bytes=16_000_000))
    assert (caught.value.fields["name"], caught.value.fields["value"]) == ("max_bytes", 16_048_000)


def test_points_of_the_answer_are_known_from_the_header() -> None:
    """Too many points out are refused before a point is read."""
    with pytest.raises(LimitExceededError) as caught:
        stages.prepare(archive(0), replace(REQUEST, max_output_points=15_999))
    assert caught.value.code == "too_many_output_points"


def test_an_answer_must_fit_into_a_worker() -> None:
    """An answer that no worker has the memory to make is refused; one that fits is not."""
    rng = np.random.default_rng(0)
    scalars = {f"s{i}": np.full(500, 0.5) for i in range(500)}
    cloud = Cloud(rng.normal(size=(500, 3)), scalars=scalars)
    plan = make_plan(cloud, Options(ratio=32.0))
    answer = 16_000 * (24 + 500 * 8 + 12)
    check_plan(plan, replace(REQUEST, worker_bytes=2 << 30), in_parts=False)
    check_plan(plan, REQUEST, in_parts=False)
    with pytest.raises(LimitExceededError) as caught:
        check_plan(plan, replace(REQUEST, worker_bytes=1 << 30), in_parts=False)
    assert caught.value.code == "too_much_memory"
    assert (caught.value.fields["name"], caught.value.fields["value"]) == ("worker_memory", answer)


def test_points_of_a_spacing_are_counted_by_the_plan() -> None:
    """With a spacing the number of points follows from the surface: few of many are no excess."""
    plane = np.column_stack([*np.random.default_rng(0).random((2, 2000)), np.zeros(2000)])
    size = Declared(2000, 24)
    wide, fine = Options(spacing=0.05), Options(spacing=0.008)
    request = replace(REQUEST, max_output_points=2000)
    check_answer(size, wide, request)
    check_answer(size, fine, request)
    few = make_plan(Cloud(plane), wide)
    assert few.n_out < 1000
    check_plan(few, request, in_parts=False)
    with pytest.raises(LimitExceededError, match="wider spacing") as caught:
        check_plan(make_plan(Cloud(plane), fine), request, in_parts=False)
    assert caught.value.code == "too_many_output_points"
