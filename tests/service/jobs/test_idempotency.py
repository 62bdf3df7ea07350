# SPDX-License-Identifier: Apache-2.0
"""Idempotency-Key: the same request sent again is the same job."""

import asyncio
from typing import Any


def test_the_same_again(play: Any) -> None:
    """Same key, options and body give one job, run once; 202 while it is active, then 200."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit(Idempotency_Key="k")
        again = await house.submit(Idempotency_Key="k")
        assert again["id"] == job["id"]
        house.engine.hold.set()
        await house.until(job["id"], "succeeded")
        late = await house.http.post(
            "/jobs?R=2", content=b"cloud", headers={"Idempotency-Key": "k"}
        )
        assert (late.status_code, late.json()["id"]) == (200, job["id"])
        assert late.headers["location"] == f"/jobs/{job['id']}"
        assert house.engine.began == [b"cloud"]
        await house.eventually(lambda: house.names("inputs") == [])

    play(scenario)


def test_another_request_under_the_same_key(play: Any) -> None:
    """Another body or other options give a 422 that names the job; no file is left."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit(Idempotency_Key="k")
        for query, body in (
            ("?R=2", b"another"),
            ("?R=3", b"cloud"),
            ("?R=2&format=xyz", b"cloud"),
        ):
            headers = {"Idempotency-Key": "k"}
            answer = await house.http.post(f"/jobs{query}", content=body, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (422, "idempotency_key_reused")
            assert answer.json()["job"] == job["id"]
        assert house.names("inputs") == [job["id"]]

    play(scenario)


def test_many_at_once(play: Any) -> None:
    """Ten simultaneous requests give one job."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        calls = [house.submit(Idempotency_Key="k") for _ in range(10)]
        found = await asyncio.gather(*calls)
        assert len({job["id"] for job in found}) == 1
        house.engine.hold.set()
        await house.until(found[0]["id"], "succeeded")
        assert house.engine.began == [b"cloud"]

    play(scenario)


def test_a_full_queue_knows_its_keys(play: Any) -> None:
    """A repeated request is answered even if the capacity is exhausted."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit(Idempotency_Key="k")
        refused = await house.http.post("/jobs", content=b"x")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_full")
        assert (await house.submit(Idempotency_Key="k"))["id"] == job["id"]

    play(scenario, jobs_queue=1)


def test_keys_outlive_a_restart(open_house: Any) -> None:
    """A request that is repeated after a restart returns the same job."""

    async def whole() -> None:
        async with open_house() as house:
            job = await house.submit(Idempotency_Key="k")
        async with open_house() as house:
            headers = {"Idempotency-Key": "k"}
            again = await house.http.post("/jobs?R=2", content=b"cloud", headers=headers)
            assert again.json()["id"] == job["id"]

    asyncio.run(whole())
