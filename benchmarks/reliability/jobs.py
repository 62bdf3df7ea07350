# SPDX-License-Identifier: Apache-2.0
"""A client of jobs that believes nothing: it asks until it knows, and sends everything twice."""

import asyncio
import time
from typing import Any

import httpx2

from benchmarks.reliability.clouds import Ask, Book

__all__ = ["JobClient"]

_LOST_S = 900.0
_PAUSE_S = 0.5
_FINAL = frozenset({"succeeded", "failed", "cancelled", "expired"})


class JobClient:
    """Runs jobs against a service that may be gone at any moment.

    Args:
        client: sends.
        url: of the service.
        book: knows what is right.

    Attributes:
        accepted: keys under which the service took a job.
        succeeded: jobs whose result was fetched and right.
        resent: requests sent again under a key that had been answered.
        lost: what became of the others.
        doubled: keys that led to more than one job.
    """

    def __init__(self, client: httpx2.AsyncClient, url: str, book: Book) -> None:
        self._client = client
        self._url = url
        self._book = book
        self.accepted = 0
        self.succeeded = 0
        self.resent = 0
        self.lost: list[str] = []
        self.doubled: list[str] = []

    async def run(self, asked: Ask, key: str) -> None:
        """Submit a job, follow it to its end, check its result, and submit it once more."""
        job = await self._submit(asked, key)
        self.accepted += 1
        told = await self._until_final(job["id"])
        if told["state"] != "succeeded":
            self.lost.append(f"{key} {told['state']}: {told.get('problem')}")
            return
        result = await self._answer("GET", f"/jobs/{job['id']}/result")
        if result.status_code != 200:
            self.lost.append(f"{key}: result {result.status_code}")
        elif self._book.check(asked, result.content):
            self.succeeded += 1
        again = await self._submit(asked, key)
        self.resent += 1
        if again["id"] != job["id"]:
            self.doubled.append(key)

    async def listed(self) -> int:
        """Jobs that the service knows of."""
        found, cursor = 0, None
        while True:
            query = {"limit": "100", **({"cursor": cursor} if cursor else {})}
            page = (await self._answer("GET", "/jobs", params=query)).json()
            found += len(page["jobs"])
            cursor = page["next"]
            if not cursor:
                return found

    async def _submit(self, asked: Ask, key: str) -> dict[str, Any]:
        response = await self._answer(
            "POST",
            "/jobs",
            params=asked.query,
            content=asked.body,
            headers={"Idempotency-Key": key},
        )
        if response.status_code not in (200, 202):
            raise RuntimeError(f"{key}: {response.status_code} {response.text[:300]}")
        job: dict[str, Any] = response.json()
        return job

    async def _until_final(self, job_id: str) -> dict[str, Any]:
        end = time.monotonic() + _LOST_S
        while time.monotonic() < end:
            response = await self._answer("GET", f"/jobs/{job_id}")
            if response.status_code != 200:
                return {"state": f"{response.status_code}", "problem": response.text[:300]}
            told: dict[str, Any] = response.json()
            if told["state"] in _FINAL:
                return told
            await asyncio.sleep(_PAUSE_S)
        return {"state": "never ended"}

    async def _answer(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Ask until there is an answer that is no 503.

        Raises:
            RuntimeError: there was none for a quarter of an hour.
        """
        end = time.monotonic() + _LOST_S
        while time.monotonic() < end:
            try:
                async with asyncio.timeout(_LOST_S):
                    response = await self._client.request(method, self._url + path, **options)
            except (httpx2.TransportError, TimeoutError):
                await asyncio.sleep(_PAUSE_S)
                continue
            if response.status_code != 503:
                return response
            await asyncio.sleep(_PAUSE_S)
        raise RuntimeError(f"{method} {path}: no answer")
