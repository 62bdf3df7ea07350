# SPDX-License-Identifier: Apache-2.0
"""Submission of a job: quota first, then its input on disk, then its row in the table."""

import asyncio
import functools
import hashlib
import json
import re
from typing import Any

import structlog
from sqlalchemy import Connection
from sqlalchemy.exc import IntegrityError
from starlette.requests import Request

from pugeo_model import formats
from pugeo_model.errors import CloudError, LimitExceededError
from pugeo_model.options import Options
from pugeo_service.admission.admission import Admission
from pugeo_service.engine.answer_size import check_answer
from pugeo_service.http.body import announced_bytes, receive_into
from pugeo_service.http.negotiation import OutputChoice
from pugeo_service.http.query import JobQuery, UpsampleQuery
from pugeo_service.jobs import clock, repository, webhook_rows
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.models import Job, new_id
from pugeo_service.jobs.quota import Quota
from pugeo_service.jobs.webhook_address import check_url
from pugeo_service.models import Models, wants_canary
from pugeo_service.problems import ProblemError
from pugeo_service.runs import make_run_request
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problems

__all__ = ["Submission", "idempotency_key"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_KEY = re.compile(r"[\x21-\x7e]([\x20-\x7e]{0,253}[\x21-\x7e])?")


def idempotency_key(request: Request) -> str | None:
    """Return the ``Idempotency-Key`` of a request, if there is one.

    Raises:
        ProblemError: 400, the key is malformed.
    """
    key = request.headers.get("idempotency-key")
    if key is not None and not _KEY.fullmatch(key):
        detail = "Idempotency-Key must be 1 to 255 printable ASCII characters."
        raise ProblemError(400, "bad_idempotency_key", detail)
    return key


class Submission:
    """Accepts jobs.

    Args:
        settings: limits.
        database: database of jobs.
        files: files of jobs.
        uploads: bounds the bodies that are being received.
        models: models by name.
    """

    def __init__(
        self,
        settings: Settings,
        database: Database,
        files: JobFiles,
        uploads: Admission,
        models: Models,
    ) -> None:
        self._settings = settings
        self._database = database
        self._files = files
        self._uploads = uploads
        self._models = models
        self._quota = Quota(settings.jobs_queue, settings.jobs_bytes)

    async def __call__(
        self,
        request: Request,
        query: JobQuery,
        choice: OutputChoice,
        owner: str,
        key: str | None,
    ) -> tuple[Job, bool]:
        """Accept a job; once this returns, the job survives a crash of this process.

        Args:
            request: request whose body is the input.
            query: options.
            choice: format of the result, which may depend on that of the input.
            owner: name of the API key.
            key: idempotency key of the client, or ``None``.

        Returns:
            The job, and True if it is new. A repeated request returns the earlier job.

        Raises:
            LimitExceededError: the header of the input says that it, or its answer, is too large.
            ProblemError: see `receive_body`; 422 the key belongs to another request, 429 the owner
                has its share, 503 the capacity is exhausted, the disk is full, or the database
                fails.
        """
        self._check_webhook(query.webhook)
        # The model of a job without one is chosen when it runs.
        wish = wants_canary(request.headers)
        named = query.model is not None or wish is not None
        model = self._models.choose(query.model, wish, 0.0).name if named else None
        if key is None or not await self._database.read(repository.find_by_key, owner, key):
            announced = announced_bytes(request)
            usage = await self._database.read(repository.owner_usage, owner)
            self._quota.check(owner, announced, *usage)
        job_id = new_id()
        with self._uploads.reserve(owner) as reservation, self._files.new_input(job_id) as file:
            body = await receive_into(file, request, self._settings, reservation)
            with storage_problems():
                await file.commit()
        try:
            await asyncio.to_thread(self._check_size, job_id, query, body.format)
        except CloudError:
            await asyncio.to_thread(self._files.remove_input, job_id)
            raise
        options = query.model_dump(exclude={"format", "webhook"}) | {"model": model}
        answer = choice.for_input(body.read_as).name
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
            created_at=clock.now(),
        )
        try:
            stored = await self._insert(job, query.webhook)
        except Exception:
            await self._remove_input_unless_stored(job)
            raise
        if stored.id != job.id:
            await asyncio.to_thread(self._files.remove_input, job.id)
        return stored, stored.id == job.id

    def _check_webhook(self, url: str | None) -> None:
        """Refuse a webhook that could not be sent."""
        if url is None:
            return
        if self._settings.webhook_secret is None:
            detail = "This service sends no webhooks; its operator sets PUGEO_WEBHOOK_SECRET."
            fields = {"parameter": "webhook", "setting": "PUGEO_WEBHOOK_SECRET"}
            raise ProblemError(422, "bad_option", detail, fields=fields)
        check_url(url, private=self._settings.webhook_private)

    def _check_size(self, job_id: str, query: UpsampleQuery, format: str | None) -> None:
        """Refuse an input whose header says that it, or its answer, is too large.

        Other faults of the input are those of the job.
        """
        settings = self._settings
        limits = formats.Limits(max_points=settings.max_points, max_bytes=settings.max_cloud_bytes)
        run_request = make_run_request(
            settings,
            query.for_model(),
            model=self._models.default.id,
            format=format,
            answer="",
            deadline_s=0.0,
        )
        try:
            size = formats.declared(self._files.input_path(job_id), format=format, limits=limits)
            if size is not None:
                check_answer(size, Options(**run_request.options), run_request)
        except LimitExceededError:
            raise
        except (CloudError, OSError):
            return

    async def _insert(self, job: Job, webhook: str | None) -> Job:
        """Insert a job, or return the earlier job of its owner with the same key."""
        try:
            earlier = await self._database.write(_find_or_add, job, webhook, self._quota)
        except IntegrityError:
            # The same request was sent twice at once, and the other one was inserted first.
            earlier = await self._database.write(_find_or_add, job, webhook, self._quota)
        if earlier is not None and earlier.request_digest != job.request_digest:
            detail = (
                "This Idempotency-Key was used for a request with another body or other options. "
                "Use a new key for each job."
            )
            raise ProblemError(422, "idempotency_key_reused", detail, fields={"job": earlier.id})
        return earlier or job

    async def _remove_input_unless_stored(self, job: Job) -> None:
        """Remove the input of a job that was not inserted.

        A failed commit may have succeeded after all, and then the input is needed. If the database
        cannot be read, maintenance decides later.
        """
        try:
            stored = await self._database.read(repository.find_many, [job.id])
        except ProblemError:
            _log.warning(
                "input of a refused job may remain until maintenance removes it", job=job.id
            )
            return
        if not stored:
            await asyncio.to_thread(self._files.remove_input, job.id)


def _find_or_add(connection: Connection, job: Job, webhook: str | None, quota: Quota) -> Job | None:
    """Return an earlier job with the same key, or insert the job if the quota allows it."""
    if job.idempotency_key is not None:
        earlier = repository.find_by_key(connection, job.owner, job.idempotency_key)
        if earlier is not None:
            return earlier
    repository.add(connection, job, functools.partial(quota.check, job.owner, job.input_bytes))
    if webhook is not None:
        webhook_rows.add(connection, job.id, webhook)
    return None


def _digest(options: dict[str, Any], answer: str, format: str | None, sha256: str) -> str:
    """Return a digest that equal requests share."""
    text = json.dumps([options, answer, format, sha256], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
