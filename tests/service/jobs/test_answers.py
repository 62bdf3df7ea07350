# SPDX-License-Identifier: Apache-2.0
"""Answers on their way to slow clients count against the bound of the spool."""

import asyncio
from typing import Any

SCOPE = {
    "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST",
    "scheme": "http", "path": "/upsample", "raw_path": b"/upsample", "query_string": b"",
    "headers": [(b"host", b"x")], "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
}  # fmt: skip


def test_answers_hold_their_room(play: Any) -> None:
    """An answer that nobody reads holds its bytes but no place in the queue, until it is sent."""

    async def scenario(house: Any) -> None:
        app = house.http._transport.app
        admission = app.state.service.admission
        reads, bodies = asyncio.Event(), [{"type": "http.request", "body": b"x" * 40}]

        async def receive() -> Any:
            if not bodies:
                await asyncio.Event().wait()
            return bodies.pop()

        async def send(_message: Any) -> None:
            await reads.wait()

        slow = asyncio.create_task(app(dict(SCOPE), receive, send))
        await house.eventually(lambda: admission.bytes == 86)
        assert (admission.requests, admission.patches) == (0, 0)
        refused = await house.http.post("/upsample", content=b"x" * 40)
        assert (refused.status_code, refused.json()["code"]) == (503, "queue_full")
        reads.set()
        await slow
        assert admission.bytes == 0
        assert (await house.http.post("/upsample", content=b"x" * 40)).status_code == 200
        assert admission.bytes == 0

    play(scenario, queue_bytes=100)
