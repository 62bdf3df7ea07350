# SPDX-License-Identifier: Apache-2.0
"""Problems about a limit name the setting that raises it, or say that there is none."""

import asyncio
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.requests import Request
from starlette.types import Message
from tests.service.http.fake_loop import connect

from pugeo_model.errors import LimitExceededError
from pugeo_model.formats import Limits
from pugeo_service.admission.admission import Admission, QueueUsage, Reservation
from pugeo_service.admission.fair_share import check_share
from pugeo_service.http import connection_limit, request_limits
from pugeo_service.http.body import receive_body
from pugeo_service.http.protocol import ServerProtocol
from pugeo_service.jobs.quota import Quota
from pugeo_service.jobs.repository import JobUsage
from pugeo_service.problems import NO_SETTING, ProblemError
from pugeo_service.settings import Settings

FIXED = {"max_header_bytes", "max_header_lines", "max_line_bytes"}
# Codes of refusals with one of the statuses of limits that are about something else: a state of the
# service, or the streams of events, instead of which clients poll.
OTHERS = {
    "draining", "engine_lost", "jobs_unavailable", "no_worker", "storage_failed", "storage_full",
    "too_many_watchers", "wrong_weights",
}  # fmt: skip
LIMIT_STATUSES = "408|413|429|431|503|504"


def raised(call: Callable[[], object]) -> ProblemError:
    """The problem that a call raises."""
    with pytest.raises(ProblemError) as caught:
        call()
    return caught.value


def of_the_model(name: str) -> ProblemError:
    """A limit of the model."""
    with pytest.raises(LimitExceededError) as caught:
        raise LimitExceededError("Too large.", name=name, limit=1, value=2)
    return ProblemError.from_cloud_error(caught.value)


def full_queue(patches: int, size: int, requests: int) -> ProblemError:
    """A queue that is full, found at the beginning of a request."""
    admission = Admission(10, 10, 10)
    admission.usage = QueueUsage(patches, size, requests)
    return raised(admission.reserve)


def at_admission(max_requests: int) -> ProblemError:
    """A queue that is full, found when the size of the cloud is known."""
    admission = Admission(10, 10, max_requests)
    first, second = admission.reserve(), admission.reserve()
    first.admit(9)
    return raised(lambda: second.admit(2))


def at_body() -> ProblemError:
    """A queue that is full, found while a body arrives."""
    admission = Admission(10, 10, 10)
    admission.reserve().add_bytes(9)
    return raised(lambda: admission.reserve().add_bytes(2))


def share(add: Callable[[Reservation], object]) -> ProblemError:
    """An owner that holds its share of the queue."""
    admission = Admission(10, 10, 4)
    admission.usage = QueueUsage(5, 5, 2)
    admission.usage_by_owner["ann"] = QueueUsage(5, 5, 0)
    return raised(lambda: add(Reservation(admission, "ann")))


def jobs(active: int, size: int, owned: JobUsage, owner: str = "", wanted: int = 1) -> ProblemError:
    """The quota of jobs."""
    total = JobUsage(queued=active, running=0, bytes=size)
    return raised(lambda: Quota(10, 10).check(owner, wanted, total, owned))


def streams() -> ProblemError:
    """An owner that holds its share of the streams of events."""
    return raised(
        lambda: check_share(
            "streams",
            "the event streams",
            None,
            held=9,
            held_elsewhere=9,
            wanted=1,
            free=1,
            retry_after=lambda _: 1.0,
        )
    )


def deadline(seconds: float, setting: str | None) -> ProblemError:
    """A deadline that a request cannot meet, by itself or after another one."""
    admission = Admission(1000, 10, 10)
    admission.patch_cost.add(10.0, 50)
    earlier, later = admission.reserve(), admission.reserve()
    earlier.admit(20)
    later.admit(20)
    return raised(lambda: later.check_deadline(seconds, 1, counted=True, setting=setting))


def slow_body() -> ProblemError:
    """A body that does not arrive."""

    async def receive() -> Message:
        await asyncio.Event().wait()
        raise AssertionError

    request = Request({"type": "http", "headers": []}, receive)

    async def run() -> None:
        with Admission(9, 9, 9).reserve() as reservation:
            await receive_body(request, Settings(body_idle_s=0.01), reservation)

    return raised(lambda: asyncio.run(run()))


def many_connections(setting: str | None) -> ProblemError:
    """A connection too many."""
    found: list[ProblemError] = []

    def encode(problem: ProblemError) -> bytes:
        found.append(problem)
        return b""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connection_limit, "encode_response", encode)
        connect(ServerProtocol.limited(0, setting))
    return found[0]


NOTHING = JobUsage(queued=0, running=0, bytes=0)
PROBLEMS: list[tuple[str, str | None, Callable[[], ProblemError]]] = [
    ("limit_exceeded", "MAX_POINTS", lambda: of_the_model("max_points")),
    ("limit_exceeded", "MAX_CLOUD_BYTES", lambda: of_the_model("max_bytes")),
    *(("limit_exceeded", None, lambda name=name: of_the_model(name)) for name in sorted(FIXED)),
    ("queue_full", "QUEUE_PATCHES", lambda: full_queue(10, 0, 1)),
    ("queue_full", "QUEUE_BYTES", lambda: full_queue(0, 10, 1)),
    ("queue_full", "QUEUE_REQUESTS", lambda: full_queue(0, 0, 10)),
    ("queue_full", "QUEUE_PATCHES", lambda: at_admission(9)),
    ("queue_full", "QUEUE_BYTES", at_body),
    ("share_exceeded", "QUEUE_PATCHES", lambda: share(lambda held: held.admit(1))),
    ("share_exceeded", "QUEUE_BYTES", lambda: share(lambda held: held.add_bytes(1))),
    ("share_exceeded", "JOBS_QUEUE", lambda: jobs(6, 0, JobUsage(6, 0, 0), "ann")),
    ("share_exceeded", "JOBS_BYTES", lambda: jobs(1, 6, JobUsage(0, 0, 6), "ann")),
    ("share_exceeded", None, streams),
    ("jobs_full", "JOBS_QUEUE", lambda: jobs(10, 9, NOTHING)),
    ("jobs_full", "JOBS_BYTES", lambda: jobs(9, 6, NOTHING, wanted=5)),
    ("body_too_large", "JOBS_BYTES", lambda: jobs(0, 0, NOTHING, wanted=11)),
    ("deadline_unmeetable", "DEADLINE_S", lambda: deadline(5.0, "PUGEO_DEADLINE_S")),
    ("deadline_too_short", "DEADLINE_S", lambda: deadline(1.0, "PUGEO_DEADLINE_S")),
    ("body_timeout", "BODY_IDLE_S", slow_body),
    (
        "too_many_connections", "MAX_CONNECTIONS",
        lambda: many_connections("PUGEO_MAX_CONNECTIONS"),
    ),
    ("too_many_connections", None, lambda: many_connections(None)),
    ("head_too_large", None, lambda: request_limits._too_large("too much")),
]  # fmt: skip


@pytest.mark.parametrize(("code", "setting", "make"), PROBLEMS)
def test_a_limit_names_its_setting(
    code: str, setting: str | None, make: Callable[[], ProblemError]
) -> None:
    """The member and the detail name a setting that exists; else the detail says there is none."""
    problem = make()
    assert problem.code == code
    if setting is None:
        assert "setting" not in problem.fields
        assert problem.detail.endswith(NO_SETTING)
    else:
        assert problem.fields["setting"] == f"PUGEO_{setting}"
        assert f"PUGEO_{setting}" in problem.detail
        assert setting.lower() in Settings.model_fields


def test_the_clients_own_deadline_has_no_setting() -> None:
    """If the client waits for less than the service allows, no setting of the service helps."""
    for seconds in (1.0, 5.0):
        problem = deadline(seconds, None)
        assert "setting" not in problem.fields
        assert "Ask for a longer wait" in problem.detail


def test_no_limit_is_forgotten(root: Path) -> None:
    """Each refusal whose status is one of limits is in the list above, or is about no limit."""
    pattern = re.compile(rf"ProblemError\(\s*(?:{LIMIT_STATUSES}),\s*\"(\w+)\"")
    sources = "\n".join(path.read_text("utf-8") for path in (root / "service").rglob("*.py"))
    elsewhere = {"deadline_exceeded", "head_timeout"}  # of e2e tests, and of the head's limits
    listed = {code for code, _, _ in PROBLEMS}
    assert set(pattern.findall(sources)) == OTHERS | elsewhere | (listed - {"limit_exceeded"})


def test_each_limit_of_the_model_is_known(root: Path) -> None:
    """Each name in an error of the model has a setting, or is one of those that have none."""
    pattern = re.compile(r"(?:\.check\(\s*|name=)\"((?:max|worker)_\w+)\"")
    folders = (root / "model/pugeo_model/formats", root / "service/pugeo_service/engine")
    names = {
        name
        for folder in folders
        for path in folder.rglob("*.py")
        for name in pattern.findall(path.read_text("utf-8"))
    }
    assert {*Limits.__dataclass_fields__} <= names
    fixed = {name for name in names if "setting" not in of_the_model(name).fields}
    assert fixed == FIXED
