# SPDX-License-Identifier: Apache-2.0
"""GET /jobs, and jobs of different owners."""

from typing import Any

from pugeo_service.keys import Entry, hash_of


def test_pages(play: Any) -> None:
    """Newest first, in pages without repetition or gap, also while jobs are added."""

    async def scenario(house: Any) -> None:
        ids = [(await house.submit(b"cloud %d" % number))["id"] for number in range(5)]
        seen, cursor = [], ""
        while cursor is not None:
            query = f"?limit=2&cursor={cursor}" if cursor else "?limit=2"
            page = (await house.http.get(f"/jobs{query}")).json()
            seen += [job["id"] for job in page["jobs"]]
            cursor = page["next"]
            await house.submit(b"later")
        assert seen == ids[::-1]

    play(scenario)


def test_states(play: Any) -> None:
    """?state= selects jobs; an unknown state or a limit out of range is a 422."""

    async def scenario(house: Any) -> None:
        good, bad = await house.submit(), await house.submit(b"malformed")
        await house.until(good["id"], "succeeded")
        await house.until(bad["id"], "failed")
        found = (await house.http.get("/jobs?state=failed")).json()["jobs"]
        assert [job["id"] for job in found] == [bad["id"]]
        for query in ("state=lost", "limit=0", "limit=101"):
            assert (await house.http.get(f"/jobs?{query}")).status_code == 422

    play(scenario)


def test_jobs_belong_to_their_keys(play: Any) -> None:
    """Another key can neither list, read, fetch, watch nor cancel a job."""

    async def scenario(house: Any) -> None:
        mine, theirs = ({"Authorization": f"Bearer {name}"} for name in ("mine", "theirs"))
        key = {"Idempotency-Key": "same"}
        assert (await house.http.post("/jobs", content=b"x")).status_code == 401
        job = (await house.http.post("/jobs", content=b"one", headers=mine | key)).json()
        path = f"/jobs/{job['id']}"
        assert (await house.http.get("/jobs", headers=theirs)).json()["jobs"] == []
        for method, where in (("GET", ""), ("GET", "/result"), ("GET", "/events"), ("DELETE", "")):
            answer = await house.http.request(method, path + where, headers=theirs)
            assert answer.status_code == 404
        other = await house.http.post("/jobs", content=b"two", headers=theirs | key)
        assert other.status_code == 202
        assert other.json()["id"] != job["id"]
        assert (await house.http.get(path, headers=mine)).status_code == 200

    entries = tuple(Entry(name, hash_of(name)) for name in ("mine", "theirs"))
    play(scenario, api_keys=entries)
