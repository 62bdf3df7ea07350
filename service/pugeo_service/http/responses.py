# SPDX-License-Identifier: Apache-2.0
"""The response to an upsampling request: its bytes, and headers that describe the run."""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from pugeo_service.engine import RunResult
from pugeo_service.http.negotiation import OutputFormat

__all__ = ["SpoolResponse", "response_headers", "run_headers"]

# Many proxies refuse much longer headers.
_NOTES_BYTES = 2048


def response_headers(
    result: RunResult, output: OutputFormat, model: Mapping[str, str]
) -> dict[str, str]:
    """Return all headers of the response to ``POST /upsample``."""
    return {
        **run_headers(result.report, result.seconds, output, model),
        "Content-Length": str(result.spool.size),
        "Vary": "Accept",
    }


def run_headers(
    report: dict[str, Any],
    seconds: dict[str, float],
    output: OutputFormat,
    model: Mapping[str, str],
) -> dict[str, str]:
    """Return the headers that describe a run.

    ``Pugeo-Notes`` is a JSON array of sentences in ASCII, ``Server-Timing`` is in milliseconds.

    Args:
        report: the model's report of the run.
        seconds: of each stage.
        output: format of the bytes.
        model: ``name``, ``version`` and ``sha256`` of the weights.
    """
    dropped = report["dropped"]
    timing = [f"{stage};dur={1000 * spent:.1f}" for stage, spent in seconds.items()]
    return {
        "Content-Type": output.media_type,
        "Content-Disposition": f'attachment; filename="upsampled.{output.extension}"',
        # Jobs that an earlier version finished have no name.
        "Pugeo-Model": model.get("name", ""),
        "Pugeo-Model-Version": model["version"],
        "Pugeo-Model-Sha256": model["sha256"],
        "Pugeo-Points-In": str(report["points_in"]),
        "Pugeo-Points-Out": str(report["points_out"]),
        "Pugeo-Dropped-Non-Finite": str(dropped["non_finite"]),
        "Pugeo-Dropped-Duplicate": str(dropped["duplicate"]),
        # Jobs that an earlier version finished did not count these.
        "Pugeo-Dropped-Wild": str(dropped.get("wild", 0)),
        "Pugeo-Notes": _notes(report["notes"]),
        "Server-Timing": ", ".join(timing),
    }


class SpoolResponse(Response):
    """Response that sends the spool of a run and closes it in any case.

    Starlette's streaming response would leave the spool open if the client disconnects before the
    first byte.

    Args:
        result: has the spool.
        headers: of the response.
        held: closed at the end; the room that the answer takes.
    """

    def __init__(
        self, result: RunResult, headers: dict[str, str], held: AbstractContextManager[object]
    ) -> None:
        self.status_code = 200
        self.background = None
        self.init_headers(headers)
        self._result = result
        self._held = held

    async def __call__(self, _scope: Scope, _receive: Receive, send: Send) -> None:
        """Send headers and bytes."""
        with self._held, self._result.spool as spool:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            async for data in spool.chunks():
                await send({"type": "http.response.body", "body": data, "more_body": True})
            await send({"type": "http.response.body", "body": b""})


def _notes(notes: list[str]) -> str:
    """Return the first notes as far as there is room for them."""
    kept: list[str] = []
    size = len("[]")
    for note in notes:
        # No text is shorter in JSON.
        if size + len(note) > _NOTES_BYTES:
            break
        text = json.dumps(note)
        size += len(text) + (len(", ") if kept else 0)
        if size > _NOTES_BYTES:
            break
        kept.append(text)
    return f"[{', '.join(kept)}]"
