# SPDX-License-Identifier: Apache-2.0
"""The scheduler's watch over workers on other machines, which may hang or be cut off.

A process that hangs keeps its connections: its machine still confirms each packet. Dask's own limit
(``worker-ttl``) is looked at too seldom, and does not tell such a worker from one that computes.
"""

import asyncio
from typing import Any

import structlog

from pugeo_service.engine.heartbeats import HeartbeatWatch

__all__ = ["CPU_SECONDS", "WorkerWatch"]

_log = structlog.stdlib.get_logger("pugeo.scheduler")

CPU_SECONDS = "cpu_seconds"
"""Operation of nannies that tells the processor time of their worker."""

_LOOK_S = 0.5
# Longer than a report takes with up to 200 workers, so that nannies are asked seldom.
_SILENT_S = 2.5
_ANSWER_S = 1.0
# A machine that is cut off may come back with its results: its connections last for so long too.
_CUT_OFF_S = 15.0
# A nanny asks its worker to end, waits for most of this time, and then ends the process.
_KILL_S = 1.0
_RESTART_S = 30.0


class WorkerWatch:
    """Removes workers that hang, so that others get their tasks, and has them restarted.

    A worker hangs if it neither reports nor computes while its nanny, which is beside it, answers.

    Args:
        scheduler: of the workers.
    """

    def __init__(self, scheduler: Any) -> None:
        self._scheduler = scheduler
        self._near = HeartbeatWatch()
        self._far = HeartbeatWatch(idle_s=_CUT_OFF_S)
        # Answers of nannies since the last look.
        self._used: dict[str, float | None] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._restarting: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Look twice a second, until cancelled."""
        try:
            while True:
                await asyncio.sleep(_LOOK_S)
                try:
                    await self._look()
                except Exception:  # noqa: BLE001 - whatever one look meets, the next one is needed
                    _log.exception("workers cannot be watched")
        finally:
            tasks = [*self._asking.values(), *self._restarting]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _look(self) -> None:
        seen = {address: state.last_seen for address, state in self._scheduler.workers.items()}
        used, self._used = self._used, {}
        # Only where the nanny answers: of a machine that is cut off nothing is known.
        hanging = self._near.hanging(seen, used) & used.keys()
        cut_off = self._far.hanging(seen, used) - hanging
        # A look does not wait for the answers: one that is late would look like a pause.
        for address in self._near.silent(_SILENT_S) - self._asking.keys() - hanging - cut_off:
            self._asking[address] = asyncio.create_task(self._ask(address))
        for address in hanging:
            await self._replace(address, "a worker hangs")
        for address in cut_off:
            await self._replace(address, "a worker is cut off")

    async def _ask(self, address: str) -> None:
        """Ask the nanny of a worker for the processor time of its process."""
        try:
            state = self._scheduler.workers.get(address)
            if state is not None and state.nanny is not None:
                async with asyncio.timeout(_ANSWER_S):
                    answer = await getattr(self._scheduler.rpc(state.nanny), CPU_SECONDS)()
                self._used[address] = None if answer is None else float(answer)
        except Exception:  # noqa: BLE001, S110 - also errors of TLS; the machine may be gone
            pass
        finally:
            del self._asking[address]

    async def _replace(self, address: str, what: str) -> None:
        state = self._scheduler.workers.get(address)
        if state is None:
            return
        _log.error(f"{what}; others get its tasks, and it starts again", address=address)
        # Now, and not once its process has ended: others wait for its tasks. Should it go on, it
        # ends itself, and its host starts another one.
        await self._scheduler.remove_worker(address, stimulus_id=what.replace(" ", "-"))
        if state.nanny is not None:
            task = asyncio.create_task(self._restart(state.nanny))
            self._restarting.add(task)
            task.add_done_callback(self._restarting.discard)

    async def _restart(self, nanny: str) -> None:
        """Let a nanny end its process, also a stopped one; it starts another one by itself."""
        try:
            async with asyncio.timeout(_RESTART_S):
                await self._scheduler.rpc(nanny).kill(timeout=_KILL_S, reason="worker-hangs")
        except Exception as error:  # noqa: BLE001 - the machine may be gone
            reason = str(error) or type(error).__name__
            _log.warning("a worker could not be ended", nanny=nanny, reason=reason)
