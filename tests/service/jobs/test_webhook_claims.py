# SPDX-License-Identifier: Apache-2.0
"""Claims of webhooks, which a process that ends gives back."""

import asyncio
import base64
from contextlib import suppress
from typing import Any
from unittest.mock import MagicMock

import pytest

from pugeo_service.jobs import webhook_rows
from pugeo_service.jobs.webhook_rows import Due
from pugeo_service.jobs.webhooks import PREFIX, Webhooks

_DUE = Due("job", "http://localhost/", 3)


class _Database:
    """Has one webhook, and records what is written; a claim is stored before it is answered."""

    def __init__(self) -> None:
        self.written: list[tuple[Any, ...]] = []
        self.claimed = asyncio.Event()
        self.answer = asyncio.Event()
        self.sending = asyncio.Event()

    async def write(self, function: Any, *args: Any) -> Any:
        """Claim, or record another change."""
        if function is not webhook_rows.claim:
            self.written.append((function, *args))
            return None
        self.claimed.set()
        await self.answer.wait()
        return [_DUE]

    async def read(self, *_: Any) -> Any:
        """Never answer: the webhook is on its way."""
        self.sending.set()
        await asyncio.Event().wait()


@pytest.mark.parametrize("during", ["claim", "sending"])
def test_a_process_that_ends_gives_its_claims_back(during: str) -> None:
    """A claimed webhook is due at once when its process ends, with as many attempts as before."""

    async def scenario() -> list[tuple[Any, ...]]:
        database: Any = _Database()
        secret = PREFIX + base64.b64encode(b"0" * 32).decode()
        webhooks = Webhooks(database, secret, private=True, telemetry=MagicMock())
        run = asyncio.create_task(webhooks.run())
        await database.claimed.wait()
        if during == "claim":
            run.cancel()
            await asyncio.sleep(0)
        database.answer.set()
        if during == "sending":
            await database.sending.wait()
            run.cancel()
        with suppress(asyncio.CancelledError):
            await run
        assert run.cancelled()
        return list(database.written)

    assert (webhook_rows.postpone, "job", 3, 0.0) in asyncio.run(scenario())
