# SPDX-License-Identifier: Apache-2.0
"""The body of a request, taken in as it arrives and never trusted."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from starlette.requests import Request

from pugeo_model.formats import FORMATS
from pugeo_service.admission.admission import Hold
from pugeo_service.http.multipart import FilePart
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problems
from pugeo_service.storage.spool import Sink, Spool

__all__ = ["ACCEPTED", "Body", "ClientDisconnectedError", "receive_body", "receive_into"]

S = TypeVar("S", bound=Sink)

# Types that promise nothing, so that the content decides. The form type is what
# `curl --data-binary @scan.ply` says when nobody tells it otherwise.
_UNSPECIFIC = (
    "",
    "application/octet-stream",
    "binary/octet-stream",
    "application/x-www-form-urlencoded",
    "application/zip",
    "text/plain",
)
ACCEPTED: dict[str, str | None] = {
    **{kind: name for name, module in FORMATS.items() for kind in module.MEDIA_TYPES},
    **dict.fromkeys(_UNSPECIFIC),
}
_MULTIPART = "multipart/form-data"


class ClientDisconnectedError(Exception):
    """The client closed the connection; there is nobody to answer."""


@dataclass(frozen=True)
class Body(Generic[S]):
    """A body that arrived whole.

    Attributes:
        spool: its bytes; whoever holds the body closes it.
        format: the model's name of the format, or ``None`` where the content decides.
    """

    spool: S
    format: str | None


async def receive_body(request: Request, settings: Settings, hold: Hold) -> Body[Spool]:
    """Take a request's body in for as long as the request lasts; see `receive_into`."""
    with storage_problems():
        spool = Spool(settings.spool_dir)
    return await receive_into(spool, request, settings, hold)


async def receive_into(sink: S, request: Request, settings: Settings, hold: Hold) -> Body[S]:
    """Take a request's body in, raw or as the multipart part ``file``.

    Args:
        sink: takes the bytes; it is closed if anything goes wrong.
        request: a request whose body nobody has read.
        settings: the limit of bytes.
        hold: grows with each byte, and so bounds what all requests hold together.

    Raises:
        ProblemError: 400 empty or malformed, 408 too slow, 413 too large, 415 another content,
            503 where the disk is full or fails.
        ClientDisconnectedError: the connection was closed.
    """
    try:
        part, kind = _declared(request)
        arriving = _arriving(request, settings, hold)
        async for data in arriving if part is None else part.data(arriving):
            with storage_problems():
                await sink.write(data)
        _check_filled(sink)
    except BaseException:
        sink.close()
        raise
    if part is not None:
        # Browsers and libraries guess the type of a part, so an unknown one decides nothing.
        kind = part.content_type.partition(";")[0].strip().lower()
    return Body(sink, ACCEPTED.get(kind))


def _check_filled(sink: Sink) -> None:
    if sink.size == 0:
        detail = "The body is empty; send a point cloud as PLY, NPY, NPZ, JSON or text."
        raise ProblemError(400, "empty_body", detail)


def _declared(request: Request) -> tuple[FilePart | None, str]:
    """Return what finds the file in the body, if it is a form, and the type it claims to have."""
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("", "identity"):
        detail = f"Content-Encoding {encoding[:40]!r} is not understood; send plain bytes."
        raise ProblemError(
            415, "unsupported_encoding", detail, headers={"Accept-Encoding": "identity"}
        )
    declared = request.headers.get("content-type", "")
    kind = declared.partition(";")[0].strip().lower()
    if kind != _MULTIPART and kind not in ACCEPTED:
        types = [_MULTIPART, *(name for name in ACCEPTED if name)]
        detail = f"Content-Type {kind[:80]!r} is not a point cloud. Accepted: {', '.join(types)}."
        raise ProblemError(415, "unsupported_media_type", detail, fields={"accepted": types})
    return FilePart(declared) if kind == _MULTIPART else None, kind


async def _arriving(request: Request, settings: Settings, hold: Hold) -> AsyncIterator[bytes]:
    limit = settings.max_body_bytes
    announced = request.headers.get("content-length", "")
    if announced.isdecimal() and int(announced) > limit:
        raise _too_large(limit, int(announced))
    size = 0
    while True:
        try:
            async with asyncio.timeout(settings.body_idle_s):
                message = await request.receive()
        except TimeoutError as error:
            detail = f"No byte of the body arrived for {settings.body_idle_s:g} s."
            raise ProblemError(
                408, "body_timeout", detail, headers={"Connection": "close"}
            ) from error
        if message["type"] == "http.disconnect":
            raise ClientDisconnectedError
        data: bytes = message.get("body", b"")
        size += len(data)
        if size > limit:
            raise _too_large(limit, size)
        hold.grow(len(data))
        if data:
            yield data
        if not message.get("more_body", False):
            return


def _too_large(limit: int, value: int) -> ProblemError:
    detail = f"The body has {value} bytes or more; the limit is {limit}."
    return ProblemError(413, "body_too_large", detail, fields={"limit": limit, "value": value})
