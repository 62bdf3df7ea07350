# SPDX-License-Identifier: Apache-2.0
"""Fair shares of the capacity for jobs."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

from pugeo_service.keys import Entry, hash_of

KEYS = tuple(Entry(name, hash_of(name)) for name in ("ann", "bob", "cleo"))


async def post(house: Any, owner: str, body: Any = b"x", key: str | None = None) -> Any:
    """Submit a job with a key; return the answer, whatever it is."""
    headers = {"Authorization": f"Bearer {owner}"} | ({"Idempotency-Key": key} if key else {})
    return await house.http.post("/jobs", content=body, headers=headers)


def test_one_owner_leaves_room_for_others(play: Any) -> None:
    """One owner reaches half of the jobs, then gets 429; an exhausted capacity is 503."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        statuses = [(await post(house, "ann")).status_code for _ in range(2)]
        assert statuses == [202, 202]
        refused = await post(house, "ann")
        problem = refused.json()
        assert (refused.status_code, problem["code"]) == (429, "share_exceeded")
        assert problem["retryable"]
        assert int(refused.headers["retry-after"]) > 0
        told = {name: problem[name] for name in ("unit", "held", "wanted", "free")}
        assert told == {"unit": "jobs", "held": 2, "wanted": 1, "free": 2}
        assert (await post(house, "bob")).status_code == 202
        assert (await post(house, "bob")).status_code == 429
        assert (await post(house, "cleo")).status_code == 202
        for owner in ("ann", "bob", "cleo"):
            full = await post(house, owner)
            assert (full.status_code, full.json()["code"]) == (503, "jobs_full")

    play(scenario, jobs_queue=4, api_keys=KEYS)


def test_a_share_is_told_before_the_body(play: Any) -> None:
    """A share is checked before the body is read; a repeated request is still answered."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = (await post(house, "ann", key="mine")).json()
        read: list[bytes] = []

        async def body() -> AsyncIterator[bytes]:
            read.append(b"x")
            yield b"x"

        refused = await post(house, "ann", body())
        assert (refused.status_code, read) == (429, [])
        again = await post(house, "ann", key="mine")
        assert (again.status_code, again.json()["id"]) == (202, job["id"])
        headers = {"Authorization": "Bearer ann"}
        await house.http.delete(f"/jobs/{job['id']}", headers=headers)
        assert (await post(house, "ann", body())).status_code == 202
        assert read == [b"x"]

    play(scenario, jobs_queue=2, jobs_running=1, api_keys=KEYS)


def test_shares_hold_for_bytes(play: Any) -> None:
    """Shares hold for bytes of inputs and stored results."""

    async def scenario(house: Any) -> None:
        first = (await post(house, "ann", b"x" * 13)).json()
        ann = {"Authorization": "Bearer ann"}
        await house.eventually(lambda: house.names("results") == [first["id"]])
        await house.eventually(
            lambda: house.names("inputs") == []
        )  # removed after the outcome is stored
        house.engine.hold.clear()
        refused = await post(house, "ann", b"x" * 40)  # the result has 32
        problem = refused.json()
        assert (refused.status_code, problem["unit"]) == (429, "bytes")
        assert (problem["held"], problem["wanted"], problem["free"]) == (32, 40, 68)
        await house.eventually(lambda: house.names("inputs") == house.names("parts") == [])
        assert (await post(house, "bob", b"x" * 60)).status_code == 202
        assert (await post(house, "cleo", b"x" * 9)).status_code == 503
        await house.http.delete(f"/jobs/{first['id']}", headers=ann)
        assert (await post(house, "ann", b"x" * 40)).status_code == 202

    play(scenario, jobs_bytes=100, api_keys=KEYS)


def test_many_at_once_keep_to_the_share(play: Any) -> None:
    """Of ten simultaneous jobs of one owner only its share is accepted."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        answers = await asyncio.gather(*(post(house, "ann") for _ in range(10)))
        assert Counter(answer.status_code for answer in answers) == {202: 3, 429: 7}
        assert len(house.names("inputs")) == 3

    play(scenario, jobs_queue=6, api_keys=KEYS)


def test_without_keys_there_are_no_shares(play: Any) -> None:
    """Without owners the whole capacity can be used; the next job gets 503."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        statuses = [(await house.http.post("/jobs", content=b"x")).status_code for _ in range(5)]
        assert statuses == [202] * 4 + [503]

    play(scenario, jobs_queue=4)
