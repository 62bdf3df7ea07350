# SPDX-License-Identifier: Apache-2.0
"""Count of tasks that Dask repeated after the loss of a worker or of a result.

Dask repeats such tasks without a report; only the scheduler sees it.
"""

from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

__all__ = ["TOPIC", "ReportRetries"]

TOPIC = "pugeo-retries"


class ReportRetries(SchedulerPlugin):
    """Reports the key of each repeated task on ``TOPIC``; runs in the scheduler."""

    name = TOPIC
    # Several fronts may share a scheduler; the first one registers the plugin for all.
    idempotent = True

    def __init__(self) -> None:
        self._begun: set[Any] = set()
        self._scheduler: Any = None

    async def start(self, scheduler: Any) -> None:
        """Keep the scheduler, which sends the events."""
        self._scheduler = scheduler

    def transition(self, key: Any, start: str, finish: str, *_: Any, **__: Any) -> None:
        """Handle a change of state of a task; work stealing causes none."""
        del start
        if finish == "forgotten":
            self._begun.discard(key)
        elif finish == "processing" and key in self._begun:
            self._scheduler.log_event(TOPIC, key)
        elif finish == "processing":
            self._begun.add(key)
