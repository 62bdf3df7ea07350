# SPDX-License-Identifier: Apache-2.0
"""Jobs as values, and their table, in SQL that SQLite and PostgreSQL both support."""

import functools
import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Double,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
)

from pugeo_service.http.negotiation import OUTPUT_FORMATS
from pugeo_service.problems import ProblemError

__all__ = [
    "ACTIVE",
    "FINAL",
    "Job",
    "State",
    "Success",
    "UnreadableRowError",
    "is_id",
    "jobs",
    "metadata",
    "new_id",
]

State = Literal["queued", "running", "succeeded", "failed", "cancelled", "expired"]
ACTIVE: tuple[State, ...] = ("queued", "running")
_ID = re.compile("[0-9a-f]{32}")
# The last second that a date can have.
_LATEST_S = 253_402_300_799.0
_TIMES = ("created_at", "started_at", "finished_at", "expires_at")
FINAL: tuple[State, ...] = ("succeeded", "failed", "cancelled", "expired")


def new_id() -> str:
    """Make an id: 12 digits of the time in ms and 20 random ones, hexadecimal.

    Ids sort by age, so lists need no second column for paging, and cannot be guessed.
    """
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(10)}"


def is_id(text: str) -> bool:
    """Return whether a text has the form of `new_id`."""
    return _ID.fullmatch(text) is not None


class UnreadableRowError(Exception):
    """A row of the table is no job.

    Attributes:
        job_id: its id.
        columns: those that cannot be read.
    """

    def __init__(self, job_id: str, columns: list[str]) -> None:
        super().__init__(f"job {job_id[:32]}: {', '.join(columns)}")
        self.job_id = job_id
        self.columns = columns

    @staticmethod
    def problem() -> ProblemError:
        """Return the problem for requests about this job."""
        detail = "The record of this job is damaged; submit it again."
        return ProblemError(500, "job_unreadable", detail, retryable=False)


@dataclass(frozen=True)
class Success:
    """Description of a result on disk.

    Attributes:
        size: bytes of the file.
        sha256: of those bytes, hexadecimal.
        report: the model's report of the run.
        timings: seconds of each stage.
        model: ``version`` and ``sha256`` of the weights.
        patches: number of patches that went through the network.
    """

    size: int
    sha256: str
    report: dict[str, Any]
    timings: dict[str, float]
    model: dict[str, str]
    patches: int


@dataclass(frozen=True)
class Job:
    """One job. Times are seconds since 1970 in UTC.

    Attributes:
        id: see `new_id`.
        owner: name of the API key of its request, ``""`` without keys.
        state: state of its life cycle.
        revision: grows with each visible change.
        idempotency_key: name of the request given by the client, or ``None``.
        request_digest: sha256 of options and body, to recognise a repeated request.
        request_id: id of the request that created it, for the log.
        options: the query, as the fields of ``UpsampleQuery``.
        format: format of the input, or ``None`` if the content decides.
        answer: format of the result.
        input_bytes: size of the input.
        input_sha256: sha256 of the input, hexadecimal.
        stage: current or last stage.
        patches_done: number of patches that went through the network.
        patches_total: number of patches, ``None`` until the cloud is prepared.
        attempts: number of starts, without those that ended by a shutdown.
        runner: the process that runs it, or ``None``.
        not_before: earliest start.
        created_at: time of its acceptance.
        started_at: time of its last start.
        finished_at: time of its end.
        expires_at: time at which its result is deleted.
        result_bytes: size of the result.
        result_sha256: sha256 of the result, hexadecimal.
        report: report of the model.
        timings: seconds of each stage.
        model: ``version`` and ``sha256`` of the weights that ran.
        problem: reason of its failure, as problem+json.
    """

    id: str
    owner: str
    state: State
    revision: int
    idempotency_key: str | None
    request_digest: str
    request_id: str
    options: dict[str, Any]
    format: str | None
    answer: str
    input_bytes: int
    input_sha256: str
    created_at: float
    stage: str = "queued"
    patches_done: int = 0
    patches_total: int | None = None
    attempts: int = 0
    runner: str | None = None
    not_before: float = 0.0
    started_at: float | None = None
    finished_at: float | None = None
    expires_at: float | None = None
    result_bytes: int | None = None
    result_sha256: str | None = None
    report: dict[str, Any] | None = None
    timings: dict[str, float] | None = None
    model: dict[str, str] | None = None
    problem: dict[str, Any] | None = None

    @classmethod
    def from_row(cls, row: Mapping[Any, Any]) -> "Job":
        """Make a job of a row of the table.

        Raises:
            UnreadableRowError: a value is not of its type or range; the row was damaged, or written
                by another version.
        """
        try:
            job = _rows().validate_python(dict(row))
        except ValidationError as error:
            columns = sorted({str(entry["loc"][0]) for entry in error.errors() if entry["loc"]})
            raise UnreadableRowError(str(row.get("id")), columns) from None
        wrong = [name for name in _TIMES if (getattr(job, name) or 0.0) > _LATEST_S]
        if job.answer not in OUTPUT_FORMATS:
            wrong.append("answer")
        if job.state == "succeeded" and None in (job.result_bytes, job.result_sha256, job.report):
            wrong.append("result")
        if wrong:
            raise UnreadableRowError(job.id, wrong)
        return job

    @property
    def finished(self) -> bool:
        """Whether it has ended."""
        return self.state in FINAL

    def has_result(self, now: float) -> bool:
        """Whether its result may be fetched at the time ``now``."""
        return self.state == "succeeded" and (self.expires_at is None or now < self.expires_at)


@functools.cache
def _rows() -> TypeAdapter[Job]:
    return TypeAdapter(Job)


metadata = MetaData()

# Times are seconds as numbers: SQLite has no type for them.
jobs = Table(
    "pugeo_jobs",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("owner", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("idempotency_key", String(255)),
    Column("request_digest", String(64), nullable=False),
    Column("request_id", String(128), nullable=False),
    Column("options", JSON, nullable=False),
    Column("format", String(32)),
    Column("answer", String(32), nullable=False),
    Column("input_bytes", BigInteger, nullable=False),
    Column("input_sha256", String(64), nullable=False),
    Column("created_at", Double, nullable=False),
    Column("stage", String(32), nullable=False),
    Column("patches_done", Integer, nullable=False),
    Column("patches_total", Integer),
    Column("attempts", Integer, nullable=False),
    Column("runner", String(64)),
    Column("not_before", Double, nullable=False),
    Column("started_at", Double),
    Column("finished_at", Double),
    Column("expires_at", Double),
    Column("result_bytes", BigInteger),
    Column("result_sha256", String(64)),
    Column("report", JSON(none_as_null=True)),
    Column("timings", JSON(none_as_null=True)),
    Column("model", JSON(none_as_null=True)),
    Column("problem", JSON(none_as_null=True)),
    # Rows without a key do not conflict: in both databases NULL is not equal to NULL.
    UniqueConstraint("owner", "idempotency_key", name="pugeo_jobs_key"),
    Index("pugeo_jobs_state", "state", "id"),
    Index("pugeo_jobs_owner", "owner", "id"),
)
