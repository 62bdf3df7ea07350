# SPDX-License-Identifier: Apache-2.0
"""The result of a job over HTTP, with conditional and range requests (RFC 9110)."""

import base64
from email.utils import formatdate

import structlog
from starlette.requests import Request
from starlette.responses import FileResponse, MalformedRangeHeader, RangeNotSatisfiable, Response

from pugeo_service.http.negotiation import OUTPUT_FORMATS
from pugeo_service.http.responses import run_headers
from pugeo_service.jobs import clock
from pugeo_service.jobs.files import JobFiles, ResultLostError
from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError
from pugeo_service.storage.problems import storage_problem

__all__ = ["check_available", "result_response"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_UNFINISHED_RETRY_S = 1.0


def check_available(job: Job) -> None:
    """Refuse the result of a job that has none.

    Raises:
        ProblemError: 409 the job is not finished, 410 its result was deleted, or the problem with
            which the job failed.
    """
    if job.has_result(clock.now()):
        return
    fields = {"job": job.id, "state": job.state}
    if job.problem is not None:
        problem = job.problem
        fields |= {name: value for name, value in problem.items() if name not in _STANDARD}
        raise ProblemError(
            problem["status"], problem["code"], problem["detail"], retryable=False, fields=fields
        )
    if not job.finished:
        detail = f"The job is {job.state}; its result exists once its state is succeeded."
        raise ProblemError(
            409, "job_not_finished", detail, retryable=True, retry_after=_UNFINISHED_RETRY_S,
            fields=fields,
        )  # fmt: skip
    if job.state == "cancelled":
        raise ProblemError(410, "job_cancelled", "The job was cancelled.", fields=fields)
    raise _deleted(job)


def result_response(request: Request, job: Job, files: JobFiles) -> Response:
    """Build the response with a result. It accesses the disk, so call it in a thread.

    Args:
        request: request with optional ``If-None-Match``, ``If-Range`` and ``Range``.
        job: a job that passed `check_available`.
        files: files of jobs.

    Raises:
        ProblemError: 410, the file does not exist; 500, its bytes have changed; 503, the disk or
            the store fails.
    """
    assert job.result_bytes is not None
    assert job.result_sha256 is not None
    assert job.report is not None
    etag = f'"{job.result_sha256}"'
    digest = base64.b64encode(bytes.fromhex(job.result_sha256)).decode()
    headers = {
        **run_headers(
            job.report, job.timings or {}, OUTPUT_FORMATS[job.answer], job.model or _NO_MODEL
        ),
        "ETag": etag,
        # The result of a job never changes; a client may cache it, a shared cache may not.
        "Cache-Control": "private, no-cache",
        "Repr-Digest": f"sha-256=:{digest}:",
    }
    if job.expires_at is not None:
        headers["Expires"] = formatdate(job.expires_at, usegmt=True)
    if _matches(request.headers.get("if-none-match"), etag):
        kept = {name: headers[name] for name in _NOT_MODIFIED_HEADERS if name in headers}
        return Response(status_code=304, headers=kept)
    try:
        path = files.result(job.id, job.result_bytes, job.result_sha256)
        status = path.stat()
    except FileNotFoundError as error:
        raise _deleted(job) from error
    except ResultLostError as error:
        _log.error("result of a job is damaged", job=job.id, reason=str(error))
        detail = f"The service lost the result of this job: {error}. Submit the job again."
        raise ProblemError(500, "result_lost", detail, retryable=False) from error
    except OSError as error:
        raise storage_problem(error) from error
    media_type = headers.pop("Content-Type")
    return _ResultFile(path, headers=headers, media_type=media_type, stat_result=status)


_STANDARD = frozenset({
    "type", "title", "status", "detail", "instance", "code", "request_id", "retryable",
})  # fmt: skip
_NOT_MODIFIED_HEADERS = ("ETag", "Cache-Control", "Expires")
_NO_MODEL = {"version": "", "sha256": ""}


class _ResultFile(FileResponse):
    """Starlette's file response, with problems as errors."""

    @classmethod
    def _parse_range_header(cls, http_range: str, file_size: int) -> list[tuple[int, int]]:
        try:
            return super()._parse_range_header(http_range, file_size)
        except MalformedRangeHeader:
            # RFC 9110, section 14.2: a malformed Range is ignored.
            return []
        except RangeNotSatisfiable as error:
            detail = (
                f"The range {http_range[:80]!r} is not within the {file_size} bytes of the result."
            )
            headers = {"Content-Range": f"bytes */{file_size}"}
            fields = {"size": file_size}
            problem = ProblemError(416, "bad_range", detail, headers=headers, fields=fields)
            raise problem from error


def _matches(header: str | None, etag: str) -> bool:
    tags = [tag.strip().removeprefix("W/") for tag in (header or "").split(",")]
    return etag in tags or "*" in tags


def _deleted(job: Job) -> ProblemError:
    detail = "The result was deleted, after its time or by DELETE; submit the job again."
    return ProblemError(410, "result_gone", detail, fields={"job": job.id, "state": job.state})
