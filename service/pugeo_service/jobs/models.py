# SPDX-License-Identifier: Apache-2.0
"""A job as a value: what a row of the database says."""

import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

__all__ = ["ACTIVE", "FINAL", "Job", "State", "Success", "new_id"]

State = Literal["queued", "running", "succeeded", "failed", "cancelled", "expired"]
ACTIVE: tuple[State, ...] = ("queued", "running")
FINAL: tuple[State, ...] = ("succeeded", "failed", "cancelled", "expired")


def new_id() -> str:
    """Make an id: 12 digits of the time in ms and 20 random ones, hexadecimal.

    Ids sort by age, so that paging through a list needs no second column, and nobody guesses one.
    """
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(10)}"


@dataclass(frozen=True)
class Success:
    """What is noted of a result that lies on disk.

    Attributes:
        size: bytes of the file.
        sha256: of those bytes, hexadecimal.
        report: the model's report of the run.
        timings: seconds of each stage.
        model: ``version`` and ``sha256`` of the weights.
        patches: that went through the network.
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
        owner: name of the API key that sent it, ``""`` without keys.
        state: where it is in its life.
        revision: grows with every change that somebody might watch.
        idempotency_key: the client's own name of the request, or ``None``.
        request_digest: sha256 of options and body: tells a repeated request from another one.
        request_id: the request that brought it, for the log.
        options: the query, as the fields of ``UpsampleQuery``.
        format: the input's format, or ``None`` where the content decides.
        answer: format of the result.
        input_bytes: size of the input.
        input_sha256: of the input, hexadecimal.
        stage: what is done now, or was done last.
        patches_done: patches that went through the network.
        patches_total: patches in all, ``None`` until the cloud is prepared.
        attempts: times that it was begun and not given back.
        runner: the process that runs it, or ``None``.
        not_before: it is not begun earlier.
        created_at: it was accepted.
        started_at: it was begun, last time.
        finished_at: its end.
        expires_at: its result is deleted.
        result_bytes: size of the result.
        result_sha256: of the result, hexadecimal.
        report: the model's report.
        timings: seconds of each stage.
        model: ``version`` and ``sha256`` of the weights that ran.
        problem: why it failed, as problem+json.
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
        """Make one of a row with the same columns."""
        return cls(**row)

    @property
    def finished(self) -> bool:
        """Whether nothing will be done for it any more."""
        return self.state in FINAL

    def result_there(self, now: float) -> bool:
        """Whether its result may be fetched at the time ``now``."""
        return self.state == "succeeded" and (self.expires_at is None or now < self.expires_at)
