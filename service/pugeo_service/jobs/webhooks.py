# SPDX-License-Identifier: Apache-2.0
"""Webhooks: a signed POST to an address of the client when a job has ended.

The form is that of the Standard Webhooks specification (version 1): headers ``webhook-id``,
``webhook-timestamp`` and ``webhook-signature``, which is ``v1,`` and the base64 HMAC-SHA256 of
``id.timestamp.body``. The id is the same at each attempt, so that receivers recognise repetitions.
"""

import asyncio
import base64
import hashlib
import hmac
import time
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import httpx2
import structlog

from pugeo_service.jobs import clock, repository, webhook_rows
from pugeo_service.jobs.api_models import JobResponse
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.models import Job
from pugeo_service.jobs.webhook_address import ForbiddenAddressError, resolve
from pugeo_service.jobs.webhook_rows import Due
from pugeo_service.json_encoding import encode_json
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError

__all__ = ["PREFIX", "Webhooks", "sign"]

PREFIX = "whsec_"
"""The beginning of a secret; the rest is base64."""

_log = structlog.stdlib.get_logger("pugeo.webhooks")
_POLL_S = 1.0
_TIMEOUT_S = 15.0
# Longer than an attempt, after which another process may take over.
_CLAIM_S = 60.0
_AT_ONCE = 64
_WAITS_S = (5.0, 60.0, 300.0, 1800.0, 7200.0, 18_000.0)
"""Seconds between attempts; after the last one, some 7.5 hours later, the webhook is given up."""
_ORPHANS_S = 3600.0


class Webhooks:
    """Sends the webhooks of jobs that have ended.

    Args:
        database: database of jobs.
        secret: key of the signatures, in the form of the specification.
        private: whether addresses that are not public are allowed.
        telemetry: counts attempts.
    """

    def __init__(
        self, database: Database, secret: str, *, private: bool, telemetry: Telemetry
    ) -> None:
        self._database = database
        self._secret = base64.b64decode(secret.removeprefix(PREFIX))
        self._private = private
        self._telemetry = telemetry

    async def run(self) -> None:
        """Send webhooks until this is cancelled; one that gets no answer holds up no other."""
        cleaned = -_ORPHANS_S
        sending: dict[asyncio.Task[None], Due] = {}
        # No proxy of the environment: it would look the name up once more, somewhere else.
        async with httpx2.AsyncClient(trust_env=False, timeout=_TIMEOUT_S) as client:
            try:
                while True:
                    with suppress(ProblemError):  # logged by the database
                        if time.monotonic() - cleaned >= _ORPHANS_S:
                            await self._database.write(webhook_rows.remove_orphans)
                            cleaned = time.monotonic()
                        for due in await self._claim(_AT_ONCE - len(sending)):
                            task = asyncio.create_task(self._send(client, due))
                            sending[task] = due
                            task.add_done_callback(sending.pop)
                    await asyncio.sleep(_POLL_S)
            finally:
                left = dict(sending)
                for task in left:
                    task.cancel()
                await asyncio.gather(*left, return_exceptions=True)
                # Also of tasks that were cancelled before they began.
                await self._release(due for task, due in left.items() if task.cancelled())

    async def _claim(self, room: int) -> list[Due]:
        now = clock.now()
        write = self._database.write(webhook_rows.claim, now, now + _CLAIM_S, room)
        claim = asyncio.ensure_future(write)
        try:
            return await asyncio.shield(claim)
        except asyncio.CancelledError:
            # The database may have stored the claim already.
            with suppress(ProblemError):
                await self._release(await claim)
            raise

    async def _release(self, claimed: Iterable[Due]) -> None:
        """Make webhooks due at once: this process ends, and the next one need not wait."""
        for due in claimed:
            with suppress(ProblemError):  # logged by the database; due again after the claim
                await self._database.write(webhook_rows.postpone, due.job_id, due.attempts, 0.0)

    async def _send(self, client: httpx2.AsyncClient, due: Due) -> None:
        try:
            with suppress(ProblemError):  # logged by the database; the webhook is due again later
                found = await self._database.read(repository.find_many, [due.job_id])
                reason = await self._attempt(client, due, found[0]) if found else None
                await self._record(due, reason)
        except Exception:  # noqa: BLE001 - an unexpected error concerns one webhook
            _log.exception("webhook cannot be sent", job=due.job_id)

    async def _record(self, due: Due, reason: str | None) -> None:
        """Store that a webhook arrived, or the reason why it did not."""
        if reason is None:
            await self._database.free(webhook_rows.remove, due.job_id)
            self._telemetry.webhooks.labels("delivered").inc()
        elif due.attempts < len(_WAITS_S):
            attempts, later = due.attempts + 1, clock.now() + _WAITS_S[due.attempts]
            await self._database.write(webhook_rows.postpone, due.job_id, attempts, later)
            self._telemetry.webhooks.labels("failed").inc()
            _log.warning("webhook failed", job=due.job_id, reason=reason, attempt=attempts)
        else:
            await self._database.free(webhook_rows.remove, due.job_id)
            self._telemetry.webhooks.labels("given_up").inc()
            _log.error("webhook given up", job=due.job_id, reason=reason)

    async def _attempt(self, client: httpx2.AsyncClient, due: Due, job: Job) -> str | None:
        """Send a webhook once; return ``None``, or the reason why it did not arrive."""
        parts = urlsplit(due.url)
        body = encode_json(_message(job))
        message_id, seconds = f"msg_{job.id}", int(time.time())
        headers = {
            "Host": parts.netloc,
            "Content-Type": "application/json",
            "User-Agent": "pugeo-webhook",
            "webhook-id": message_id,
            "webhook-timestamp": str(seconds),
            "webhook-signature": sign(self._secret, message_id, seconds, body),
        }
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                address, port = await resolve(parts, private=self._private)
                place = f"[{address}]:{port}" if ":" in address else f"{address}:{port}"
                url = urlunsplit((parts.scheme, place, parts.path or "/", parts.query, ""))
                # The certificate is that of the name.
                extensions = {"sni_hostname": parts.hostname}
                async with client.stream(
                    "POST", url, content=body, headers=headers, extensions=extensions
                ) as response:
                    status = response.status_code
        except ForbiddenAddressError as error:
            return str(error)
        except TimeoutError:
            return f"no answer within {_TIMEOUT_S:g} s"
        except (httpx2.HTTPError, httpx2.InvalidURL, OSError) as error:
            return type(error).__name__
        return None if 200 <= status < 300 else f"status {status}"


def sign(secret: bytes, message_id: str, seconds: int, body: bytes) -> str:
    """Return the value of ``webhook-signature``.

    Args:
        secret: the key.
        message_id: value of ``webhook-id``.
        seconds: value of ``webhook-timestamp``.
        body: of the request.
    """
    signed = f"{message_id}.{seconds}.".encode() + body
    digest = hmac.new(secret, signed, hashlib.sha256).digest()
    return f"v1,{base64.b64encode(digest).decode()}"


def _message(job: Job) -> dict[str, Any]:
    ended = datetime.fromtimestamp(job.finished_at or job.created_at, UTC)
    data = JobResponse.from_job(job).model_dump(mode="json")
    return {"type": f"job.{job.state}", "timestamp": ended.isoformat(), "data": data}
