# SPDX-License-Identifier: Apache-2.0
"""The answer to an upsampling request: its bytes, and what was done in headers."""

import json
from collections.abc import Mapping
from typing import Any

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from pugeo_service.engine import RunResult
from pugeo_service.http.negotiation import Offer

__all__ = ["DenseAnswer", "answer_headers", "run_headers"]

# Servers in between refuse headers much longer than this.
_NOTES_BYTES = 2048


def answer_headers(outcome: RunResult, offer: Offer, card: dict[str, Any]) -> dict[str, str]:
    """Return all headers of an answer that is sent as soon as it is there."""
    return {
        **run_headers(outcome.report, outcome.seconds, offer, card),
        "Content-Length": str(outcome.spool.size),
        "Vary": "Accept",
    }


def run_headers(
    report: dict[str, Any], seconds: dict[str, float], offer: Offer, model: Mapping[str, Any]
) -> dict[str, str]:
    """Say in headers what was done.

    ``Pugeo-Notes`` is a JSON array of sentences in ASCII, ``Server-Timing`` is in milliseconds.

    Args:
        report: the model's report of the run.
        seconds: of each stage.
        offer: format of the bytes.
        model: ``version`` and ``sha256`` of the weights.
    """
    dropped = report["dropped"]
    timing = [f"{stage};dur={1000 * spent:.1f}" for stage, spent in seconds.items()]
    return {
        "Content-Type": offer.media_type,
        "Content-Disposition": f'attachment; filename="upsampled.{offer.extension}"',
        "Pugeo-Model-Version": str(model["version"]),
        "Pugeo-Model-Sha256": str(model["sha256"]),
        "Pugeo-Points-In": str(report["points_in"]),
        "Pugeo-Points-Out": str(report["points_out"]),
        "Pugeo-Dropped-Non-Finite": str(dropped["non_finite"]),
        "Pugeo-Dropped-Duplicate": str(dropped["duplicate"]),
        "Pugeo-Notes": _notes(report["notes"]),
        "Server-Timing": ", ".join(timing),
    }


class DenseAnswer(Response):
    """Sends an outcome and closes it, sent or not.

    Starlette's own streaming answer would leave the spool open where the client left before the
    first byte.
    """

    def __init__(self, outcome: RunResult, headers: dict[str, str]) -> None:
        self.status_code = 200
        self.background = None
        self.init_headers(headers)
        self._outcome = outcome

    async def __call__(self, _scope: Scope, _receive: Receive, send: Send) -> None:
        """Send headers and bytes."""
        with self._outcome.spool as spool:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            async for data in spool.chunks():
                await send({"type": "http.response.body", "body": data, "more_body": True})
            await send({"type": "http.response.body", "body": b""})


def _notes(notes: list[str]) -> str:
    kept = list(notes)
    while len(text := json.dumps(kept)) > _NOTES_BYTES:
        kept.pop()
    return text
