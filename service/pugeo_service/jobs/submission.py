# SPDX-License-Identifier: Apache-2.0
"""How a job is let in: room first, then its input on the disk, then its row."""

import asyncio
import functools
import hashlib
import json
import re
import time
from typing import Any

import structlog
from sqlalchemy import Connection
from sqlalchemy.exc import IntegrityError
from starlette.requests import Request

from pugeo_service.admission.admission import Admission
from pugeo_service.http.body import receive_into
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs import client_queries
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.models import Job, new_id
from pugeo_service.jobs.quota import Room
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problems

__all__ = ["Submission", "key_of"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_KEY = re.compile(r"[\x21-\x7e]([\x20-\x7e]{0,253}[\x21-\x7e])?")


def key_of(request: Request) -> str | None:
    """Return the ``Idempotency-Key`` of a request, if there is one.

    Raises:
        ProblemError: 400, it is none.
    """
    key = request.headers.get("idempotency-key")
    if key is not None and not _KEY.fullmatch(key):
        detail = "Idempotency-Key must be 1 to 255 printable ASCII characters."
        raise ProblemError(400, "bad_idempotency_key", detail)
    return key


class Submission:
    """Takes jobs in.

    Args:
        settings: limits.
        database: where jobs go.
        files: where their inputs go.
        arriving: the account of bodies on their way.
    """

    def __init__(
        self, settings: Settings, database: Database, files: JobFiles, arriving: Admission
    ) -> None:
        self._settings = settings
        self._database = database
        self._files = files
        self._arriving = arriving
        self._room = Room(settings.jobs_queue, settings.jobs_bytes)

    async def __call__(
        self, request: Request, query: UpsampleQuery, answer: str, owner: str, key: str | None
    ) -> tuple[Job, bool]:
        """Take a job in; when this returns, it will be done whatever happens to this process.

        Args:
            request: its body is the input.
            query: options.
            answer: format of the result.
            owner: name of the API key.
            key: the client's own name of this request, or ``None``.

        Returns:
            The job, and whether it is new: a request that was sent before gets the job of then.

        Raises:
            ProblemError: as `receive_body`; 422 where the key names another request; 429 where the
                owner has its share; 503 where there is no room for anybody, the disk is full,
                or the database fails.
        """
        if key is None or not await self._database.read(client_queries.by_key, owner, key):
            self._room.check(owner, 0, *await self._database.read(client_queries.usages, owner))
        job_id = new_id()
        with self._arriving.hold(owner) as hold, self._files.new_input(job_id) as file:
            body = await receive_into(file, request, self._settings, hold)
            with storage_problems():
                await file.commit()
        options = query.model_dump(exclude={"format"})
        job = Job(
            id=job_id,
            owner=owner,
            state="queued",
            revision=1,
            idempotency_key=key,
            request_digest=_digest(options, answer, body.format, file.sha256),
            request_id=request.scope.get("state", {}).get("request_id", ""),
            options=options,
            format=body.format,
            answer=answer,
            input_bytes=file.size,
            input_sha256=file.sha256,
            created_at=time.time(),
        )
        try:
            kept = await self._insert(job)
        except Exception:
            await self._withdraw_unless_there(job)
            raise
        if kept.id != job.id:
            await asyncio.to_thread(self._files.remove_input, job.id)
        return kept, kept.id == job.id

    async def _insert(self, job: Job) -> Job:
        """Insert a job, or return the one that its owner sent before under its key."""
        try:
            earlier = await self._database.write(_find_or_add, job, self._room)
        except IntegrityError:
            # The same request, sent twice at once: the other one was faster.
            earlier = await self._database.write(_find_or_add, job, self._room)
        if earlier is not None and earlier.request_digest != job.request_digest:
            detail = (
                "This Idempotency-Key was used for another request; a key names one body with "
                "its options. Take a new key for each job."
            )
            raise ProblemError(422, "idempotency_key_reused", detail, fields={"job": earlier.id})
        return earlier or job

    async def _withdraw_unless_there(self, job: Job) -> None:
        """Remove the input of a job that was not let in.

        A commit that failed may have happened all the same; then the job is one, and keeps its
        input. Where not even that can be found out, the sweep decides later.
        """
        try:
            there = await self._database.read(client_queries.many, [job.id])
        except ProblemError:
            _log.warning("an input may be left behind until the next sweep", job=job.id)
            return
        if not there:
            await asyncio.to_thread(self._files.remove_input, job.id)


def _find_or_add(connection: Connection, job: Job, room: Room) -> Job | None:
    """Return the job that has its key already, or else insert it where there is room."""
    if job.idempotency_key is not None:
        earlier = client_queries.by_key(connection, job.owner, job.idempotency_key)
        if earlier is not None:
            return earlier
    client_queries.add(connection, job, functools.partial(room.check, job.owner, job.input_bytes))
    return None


def _digest(options: dict[str, Any], answer: str, format: str | None, sha256: str) -> str:
    """Return what two requests share where they are the same."""
    text = json.dumps([options, answer, format, sha256], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
