# SPDX-License-Identifier: Apache-2.0
"""Retention of results and rows, and the capacity for jobs."""

import asyncio
import dataclasses
import sqlite3
from typing import Any

import pytest
from sqlalchemy import create_engine

from pugeo_service.jobs import repository
from pugeo_service.jobs.models import Job, metadata


def test_results_expire(play: Any) -> None:
    """After its time the result is deleted, the state is expired, and the result a 410."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        expired = await house.until(job["id"], "expired")
        assert (expired["result"], expired["report"]["points_out"]) == (None, 8)
        await house.eventually(lambda: house.names("results") == [])
        result = await house.http.get(f"/jobs/{job['id']}/result")
        assert (result.status_code, result.json()["code"]) == (410, "result_gone")

    play(scenario, jobs_ttl_s=0.2)


def test_a_result_is_not_served_a_moment_too_long(play: Any, monkeypatch: Any) -> None:
    """After its time a result is refused, even before maintenance deletes it."""
    monkeypatch.setattr("pugeo_service.jobs.maintenance._INTERVAL_S", 3600.0)

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        result = await house.until_status(f"/jobs/{job['id']}/result", 410)
        assert result.json()["code"] == "result_gone"
        assert (await house.get(job["id"]))["state"] == "succeeded"

    play(scenario, jobs_ttl_s=0.3)


def test_rows_are_forgotten(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The row of a finished job is deleted after its time; an active job is kept."""
    monkeypatch.setattr("pugeo_service.jobs.maintenance._KEEP_ROW_S", 0.2)
    monkeypatch.setattr("pugeo_service.jobs.maintenance._SWEEP_S", 0.0)

    async def scenario(house: Any) -> None:
        bad = await house.submit(b"malformed")
        await house.until(bad["id"], "failed")
        house.engine.hold.clear()
        waiting = await house.submit()
        forgotten = await house.until_status(f"/jobs/{bad['id']}", 404)
        assert forgotten.json()["code"] == "unknown_job"
        assert (await house.get(waiting["id"]))["state"] in {"queued", "running"}
        house.engine.hold.set()

    play(scenario, jobs_ttl_s=0.2)


def test_the_number_of_jobs_is_bounded(play: Any) -> None:
    """A job beyond the bound is a 503 with Retry-After."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        jobs = [await house.submit() for _ in range(2)]
        refused = await house.http.post("/jobs", content=b"x" * 100)
        problem = refused.json()
        assert (refused.status_code, problem["code"]) == (503, "jobs_full")
        assert (problem["active_jobs"], problem["capacity_jobs"]) == (2, 2)
        assert int(refused.headers["retry-after"]) > 0
        await house.http.delete(f"/jobs/{jobs[0]['id']}")
        await house.submit()

    play(scenario, jobs_queue=2)


def test_the_bytes_of_jobs_are_bounded(play: Any) -> None:
    """Inputs and stored results count; deleting a result frees its bytes."""

    async def scenario(house: Any) -> None:
        job = await house.submit(b"x" * 40)  # its result has 86
        await house.until(job["id"], "succeeded")
        refused = await house.http.post("/jobs", content=b"x" * 40)
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_full")
        assert refused.json()["bytes"] == 86
        await house.eventually(lambda: house.names("inputs") == house.names("parts") == [])
        await house.http.delete(f"/jobs/{job['id']}")
        await house.submit(b"x" * 40)

    play(scenario, jobs_bytes=100)


def test_many_at_once_keep_to_the_bound(play: Any) -> None:
    """Of ten simultaneous jobs only as many are accepted as the capacity allows."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        calls = [house.http.post("/jobs", content=b"x") for _ in range(10)]
        statuses = sorted(answer.status_code for answer in await asyncio.gather(*calls))
        assert statuses == [202] * 3 + [503] * 7
        assert len(house.names("inputs")) == 3

    play(scenario, jobs_queue=3)


def test_more_expire_than_a_statement_has_parameters() -> None:
    """More results expire at once than a statement may have parameters."""
    engine = create_engine("sqlite://")
    metadata.create_all(engine)
    job = Job(
        id="", owner="", state="succeeded", revision=1, idempotency_key=None, request_digest="",
        request_id="", options={}, format=None, answer="ply", input_bytes=1, input_sha256="",
        created_at=0.0, expires_at=1.0,
    )  # fmt: skip
    ids = [f"{number:032x}" for number in range(20)]
    with engine.begin() as connection:
        for name in ids:
            repository.add(connection, dataclasses.replace(job, id=name), lambda *_: None)
        driver: Any = connection.connection.driver_connection
        driver.setlimit(sqlite3.SQLITE_LIMIT_VARIABLE_NUMBER, 19)
        assert sorted(repository.expire(connection, 2.0)) == ids
        assert repository.expire(connection, 2.0) == []
        page = repository.list_page(connection, "", None, None, 99)
        assert {found.state for _, found in page if found is not None} == {"expired"}
    engine.dispose()
