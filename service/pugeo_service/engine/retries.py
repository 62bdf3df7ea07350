# SPDX-License-Identifier: Apache-2.0
"""How often Dask ran a task again because a worker, or its result on one, was lost.

Dask repeats such tasks by itself and tells nobody; only the scheduler sees it.
"""

from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

__all__ = ["TOPIC", "ReportRetries"]

TOPIC = "pugeo-retries"


class ReportRetries(SchedulerPlugin):
    """Tells, on ``TOPIC``, the key of each task that begins once more; runs in the scheduler."""

    name = TOPIC
    # Several fronts may share a scheduler; the first one brings the plugin for all.
    idempotent = True

    def __init__(self) -> None:
        self._begun: set[Any] = set()
        self._scheduler: Any = None

    async def start(self, scheduler: Any) -> None:
        """Learn whom to tell."""
        self._scheduler = scheduler

    def transition(self, key: Any, start: str, finish: str, *_: Any, **__: Any) -> None:
        """See a task change its state; work stealing moves a task without such a change."""
        del start
        if finish == "forgotten":
            self._begun.discard(key)
        elif finish == "processing" and key in self._begun:
            self._scheduler.log_event(TOPIC, key)
        elif finish == "processing":
            self._begun.add(key)
