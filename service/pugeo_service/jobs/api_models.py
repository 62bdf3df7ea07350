# SPDX-License-Identifier: Apache-2.0
"""A job as clients see it."""

from datetime import UTC, datetime
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field

from pugeo_service.http.negotiation import OFFERS
from pugeo_service.jobs.models import Job, State

__all__ = ["JobView", "JobsView", "ProgressView"]


class ProgressView(BaseModel):
    """How far a job is."""

    stage: Annotated[
        str,
        Field(description="queued, prepare, predict, finish, collect or done"),
    ]
    done: Annotated[int, Field(description="patches that went through the network")]
    total: Annotated[int | None, Field(description="patches in all; null until they are counted")]

    @classmethod
    def of(cls, job: Job) -> Self:
        """Show the progress of a job."""
        return cls(stage=job.stage, done=job.patches_done, total=job.patches_total)


class FileView(BaseModel):
    """A file, without its bytes."""

    bytes: int
    sha256: str


class ResultView(FileView):
    """The result of a job, as long as it can be fetched."""

    href: str
    media_type: str


class JobView(BaseModel):
    """A job; times are ISO 8601 in UTC."""

    id: str
    state: State
    progress: ProgressView
    options: Annotated[dict[str, Any], Field(description="the query, with defaults filled in")]
    input: FileView
    result: ResultView | None
    report: Annotated[
        dict[str, Any] | None,
        Field(description="points_in, points_out, dropped, patches, notes and so on"),
    ]
    timings: Annotated[dict[str, float] | None, Field(description="seconds of each stage")]
    model: Annotated[dict[str, str] | None, Field(description="version and sha256")]
    problem: Annotated[
        dict[str, Any] | None, Field(description="why it failed, as application/problem+json")
    ]
    attempts: Annotated[int, Field(description="times that it was begun")]
    request_id: str
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    expires_at: Annotated[datetime | None, Field(description="its result is deleted")]
    links: dict[str, str]

    @classmethod
    def of(cls, job: Job) -> Self:
        """Show a job."""
        path = f"/jobs/{job.id}"
        result = None
        if job.state == "succeeded":
            assert job.result_bytes is not None
            assert job.result_sha256 is not None
            result = ResultView(
                bytes=job.result_bytes,
                sha256=job.result_sha256,
                href=f"{path}/result",
                media_type=OFFERS[job.answer].media_type,
            )
        return cls(
            id=job.id,
            state=job.state,
            progress=ProgressView.of(job),
            options={**job.options, "format": job.answer},
            input=FileView(bytes=job.input_bytes, sha256=job.input_sha256),
            result=result,
            report=job.report,
            timings=job.timings,
            model=job.model,
            problem=job.problem,
            attempts=job.attempts,
            request_id=job.request_id,
            created_at=_time(job.created_at),
            started_at=None if job.started_at is None else _time(job.started_at),
            finished_at=None if job.finished_at is None else _time(job.finished_at),
            expires_at=None if job.expires_at is None else _time(job.expires_at),
            links={"self": path, "events": f"{path}/events", "result": f"{path}/result"},
        )


class JobsView(BaseModel):
    """A page of jobs, newest first."""

    jobs: list[JobView]
    next: Annotated[
        str | None, Field(description="?cursor= of the next page; null where this is the last")
    ]


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
