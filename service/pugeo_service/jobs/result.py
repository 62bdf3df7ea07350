# SPDX-License-Identifier: Apache-2.0
"""The result of a job over HTTP: whole, in parts, or not at all since the client has it."""

import base64
import time
from email.utils import formatdate
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, MalformedRangeHeader, RangeNotSatisfiable, Response

from pugeo_service.http.negotiation import OFFERS
from pugeo_service.http.responses import run_headers
from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["check_there", "result_answer"]

_NOT_YET_RETRY_S = 1.0


def check_there(job: Job) -> None:
    """Refuse the result of a job that has none.

    Raises:
        ProblemError: 409 while the job is not finished, 410 where its result is gone for good, or why
            the job failed.
    """
    if job.result_there(time.time()):
        return
    fields = {"job": job.id, "state": job.state}
    if job.problem is not None:
        told = job.problem
        fields |= {name: value for name, value in told.items() if name not in _OWN}
        raise ProblemError(
            told["status"], told["code"], told["detail"], retryable=False, fields=fields
        )
    if not job.finished and job.state != "succeeded":
        detail = f"The job is {job.state}; its result is there when its state is succeeded."
        raise ProblemError(
            409, "job_not_finished", detail, retryable=True, retry_after=_NOT_YET_RETRY_S,
            fields=fields,
        )  # fmt: skip
    if job.state == "cancelled":
        raise ProblemError(410, "job_cancelled", "The job was cancelled.", fields=fields)
    raise _gone(job)


def result_answer(request: Request, job: Job, path: Path) -> Response:
    """Answer with a result; touches the disk, so call it in a thread.

    Args:
        request: its ``If-None-Match``, ``If-Range`` and ``Range`` count.
        job: one that passed `check_there`.
        path: its file.

    Raises:
        ProblemError: 410, the file is gone.
    """
    assert job.result_sha256 is not None
    assert job.report is not None
    etag = f'"{job.result_sha256}"'
    digest = base64.b64encode(bytes.fromhex(job.result_sha256)).decode()
    headers = {
        **run_headers(job.report, job.timings or {}, OFFERS[job.answer], job.model or _NO_MODEL),
        "ETag": etag,
        # A job's result never changes: whoever has it need not ask again, but only for itself.
        "Cache-Control": "private, no-cache",
        "Repr-Digest": f"sha-256=:{digest}:",
    }
    if job.expires_at is not None:
        headers["Expires"] = formatdate(job.expires_at, usegmt=True)
    if _matches(request.headers.get("if-none-match"), etag):
        kept = {name: headers[name] for name in _OF_304 if name in headers}
        return Response(status_code=304, headers=kept)
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise _gone(job) from error
    media_type = headers.pop("Content-Type")
    return _ResultFile(path, headers=headers, media_type=media_type, stat_result=status)


_OWN = frozenset({
    "type", "title", "status", "detail", "instance", "code", "request_id", "retryable",
})  # fmt: skip
_OF_304 = ("ETag", "Cache-Control", "Expires")
_NO_MODEL = {"version": "", "sha256": ""}


class _ResultFile(FileResponse):
    """Starlette's file, whose refusals are problems."""

    @classmethod
    def _parse_range_header(cls, http_range: str, file_size: int) -> list[tuple[int, int]]:
        try:
            return super()._parse_range_header(http_range, file_size)
        except MalformedRangeHeader:
            # RFC 9110: a Range that is not understood is ignored.
            return []
        except RangeNotSatisfiable as error:
            detail = f"The range {http_range[:80]!r} is not within the {file_size} bytes there are."
            headers = {"Content-Range": f"bytes */{file_size}"}
            fields = {"size": file_size}
            problem = ProblemError(416, "bad_range", detail, headers=headers, fields=fields)
            raise problem from error


def _matches(header: str | None, etag: str) -> bool:
    tags = [tag.strip().removeprefix("W/") for tag in (header or "").split(",")]
    return etag in tags or "*" in tags


def _gone(job: Job) -> ProblemError:
    detail = "The result was deleted: its time was over, or somebody asked for it."
    return ProblemError(410, "result_gone", detail, fields={"job": job.id, "state": job.state})
