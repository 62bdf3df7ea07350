# SPDX-License-Identifier: Apache-2.0
"""Heartbeats in the database, of processes on machines that share no folder.

Each process increments a counter in its row. If a counter does not change for 15 s on the clock of
the observer, its process counts as ended. Clocks of different machines are not compared, and time
in which the database did not answer is not counted.
"""

import asyncio
import time
from collections.abc import Callable, Collection
from contextlib import suppress

from sqlalchemy import BigInteger, Column, Connection, String, Table, delete, insert, select, update

from pugeo_service.jobs.database import Database
from pugeo_service.jobs.models import metadata
from pugeo_service.problems import ProblemError

__all__ = ["RunnerBeats"]

_BEAT_S = 2.0
_DEAD_S = 15.0
# After a longer pause between two looks, nothing is known.
_PAUSE_S = 6.0
# Rows of processes that are dead for so long are deleted.
_FORGET_S = 3600.0

_runners = Table(
    "pugeo_runners",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("beat", BigInteger, nullable=False),
)


class RunnerBeats:
    """Writes the heartbeat of this process and detects ended processes.

    Args:
        database: that all processes share.
        name: unique name of this process.
        clock: monotonic time in seconds.
    """

    def __init__(
        self, database: Database, name: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._database = database
        self._name = name
        self._clock = clock
        self._looked = clock()
        # Number of each process, and the time at which it was first seen.
        self._seen: dict[str, tuple[int | None, float]] = {}

    async def beat(self) -> None:
        """Count up the number of this process.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        await self._database.write(_beat, self._name)

    async def run(self) -> None:
        """Count up until cancelled."""
        while True:
            with suppress(ProblemError):  # logged by the database
                await self.beat()
            await asyncio.sleep(_BEAT_S)

    async def stop(self) -> None:
        """Delete the row of this process, whose jobs are queued again."""
        with suppress(ProblemError):  # others delete it in time
            await self._database.free(_forget, [self._name])

    async def ended(self, names: Collection[str]) -> list[str]:
        """Return the processes among ``names`` that gave no sign of life for 15 s; call it often.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        beats: dict[str, int | None] = dict.fromkeys(names)
        beats.update(await self._database.read(_beats))
        now = self._clock()
        paused, self._looked = now - self._looked > _PAUSE_S, now
        before, self._seen = self._seen, {}
        for name, beat in beats.items():
            known = before.get(name)
            fresh = paused or known is None or known[0] != beat
            self._seen[name] = (beat, now if fresh or known is None else known[1])
        silent = {name: now - since for name, (_, since) in self._seen.items()}
        silent.pop(self._name, None)
        forgotten = [name for name, seconds in silent.items() if seconds > _FORGET_S]
        if forgotten:
            await self._database.free(_forget, forgotten)
        return [name for name in names if silent.get(name, 0.0) > _DEAD_S]


def _beat(connection: Connection, name: str) -> None:
    mine = update(_runners).where(_runners.c.name == name).values(beat=_runners.c.beat + 1)
    if connection.execute(mine).rowcount == 0:
        connection.execute(insert(_runners).values(name=name, beat=0))


def _beats(connection: Connection) -> dict[str, int]:
    return {row.name: row.beat for row in connection.execute(select(_runners))}


def _forget(connection: Connection, names: list[str]) -> None:
    connection.execute(delete(_runners).where(_runners.c.name.in_(names)))
