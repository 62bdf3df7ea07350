# SPDX-License-Identifier: Apache-2.0
"""Membership: the workers that a front can use, and the number of those lost."""

from typing import Any

import pytest

from pugeo_service.engine.backend import CORE
from pugeo_service.engine.membership import Membership

OURS, THEIRS = "tls://10.0.0.1:1", "tls://10.0.0.2:2"


def record(status: str = "running", core: bool = True) -> dict[str, Any]:
    """The scheduler's record of a worker."""
    metrics = {"memory": 1, "cpu": 0}
    resources = {CORE: 1} if core else {}
    return {"id": 0, "status": status, "resources": resources, "metrics": metrics}


def removed(worker: str, expected: bool) -> tuple[float, dict[str, Any]]:
    """The event of a worker that the scheduler no longer has."""
    return 0.0, {"action": "remove-worker", "worker": worker, "expected": expected}


def test_workers_that_can_be_used() -> None:
    """A worker counts that runs, has our core, and gives signs; none without a scheduler."""
    members = Membership()
    records = {OURS: record(), THEIRS: record("paused")}
    members.see(records, hanging=())
    assert members.names == {OURS}
    members.see(records, hanging={OURS})
    assert members.names == frozenset()
    assert len(members.uses) == 2
    members.forget()
    assert not members.names
    assert not members.uses


def test_only_workers_that_ended_by_themselves_are_lost() -> None:
    """Not those that were retired, that pause, or whose scheduler is gone."""
    members = Membership()
    members.see({OURS: record()}, hanging=())
    members.see({OURS: record("paused")}, hanging=())
    members.on_event(removed(OURS, expected=True))
    members.see({}, hanging=())
    members.forget()
    assert members.lost == 0
    members.on_event(removed(OURS, expected=False))
    assert members.lost == 1


def test_a_worker_of_another_version_is_not_missed() -> None:
    """It was never used."""
    members = Membership()
    members.see({THEIRS: record(core=False)}, hanging=())
    members.on_event(removed(THEIRS, expected=False))
    assert (members.names, members.lost) == (frozenset(), 0)


@pytest.mark.parametrize("told", ["text", {"action": "add-worker", "worker": OURS}, {}])
def test_other_events_count_nothing(told: Any) -> None:
    """Dask tells much on the same topic, and anything may be sent there."""
    members = Membership()
    members.on_event((0.0, told))
    assert members.lost == 0
