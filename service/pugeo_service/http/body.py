# SPDX-License-Identifier: Apache-2.0
"""Reception of a request body under limits that hold while the bytes arrive."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from starlette.requests import Request

from pugeo_model.formats import FORMATS, HEAD_BYTES, sniff
from pugeo_service.admission.admission import Reservation
from pugeo_service.http.multipart import FilePart
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.buffered_writer import BufferedWriter
from pugeo_service.storage.problems import storage_problems
from pugeo_service.storage.spool import Spool

__all__ = [
    "ACCEPTED",
    "Body",
    "ClientDisconnectedError",
    "announced_bytes",
    "receive_body",
    "receive_into",
]

WriterT = TypeVar("WriterT", bound=BufferedWriter)

# Unspecific types: the content decides. `curl --data-binary @scan.ply` sends the form type unless
# told otherwise.
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
    """The client closed the connection before it had an answer."""


@dataclass(frozen=True)
class Body(Generic[WriterT]):
    """A body that arrived completely.

    Attributes:
        spool: its bytes; the holder of the body closes it.
        format: the model's name of the declared format, or ``None`` if the content decides.
        read_as: the format of the content, else the declared one; ``None`` if neither is known.
    """

    spool: WriterT
    format: str | None
    read_as: str | None


async def receive_body(
    request: Request, settings: Settings, reservation: Reservation
) -> Body[Spool]:
    """Receive the body of a request into a temporary spool; see `receive_into`."""
    with storage_problems():
        spool = Spool(settings.spool_dir)
    return await receive_into(spool, request, settings, reservation)


async def receive_into(
    writer: WriterT, request: Request, settings: Settings, reservation: Reservation
) -> Body[WriterT]:
    """Receive the body of a request, raw or as the multipart part ``file``.

    Args:
        writer: receives the bytes; it is closed after an error.
        request: a request whose body was not read yet.
        settings: limits of size and idle time.
        reservation: grows with each byte, which bounds the bytes of all requests together.

    Raises:
        ProblemError: 400 empty or malformed, 408 too slow, 413 too large, 415 not a point cloud,
            503 if the disk is full or fails.
        ClientDisconnectedError: the connection was closed.
    """
    try:
        part, kind = _declared(request)
        chunks = _chunks(request, settings, reservation)
        head = bytearray()
        async for data in chunks if part is None else part.data(chunks):
            head += data[: HEAD_BYTES - len(head)]
            with storage_problems():
                await writer.write(data)
        _check_not_empty(writer)
    except BaseException:
        writer.close()
        raise
    if part is not None:
        # Browsers and libraries guess the type of a part, so an unknown one is ignored.
        kind = part.content_type.partition(";")[0].strip().lower()
    declared = ACCEPTED.get(kind)
    return Body(writer, declared, sniff(bytes(head)) or declared)


def announced_bytes(request: Request) -> int:
    """Return the length of the body that the head of a request announces; 0 if it does not."""
    announced = request.headers.get("content-length", "")
    return int(announced) if announced.isdecimal() else 0


def _check_not_empty(writer: BufferedWriter) -> None:
    if writer.size == 0:
        detail = f"The body is empty; send a point cloud. Formats: {', '.join(FORMATS)}."
        raise ProblemError(400, "empty_body", detail)


def _declared(request: Request) -> tuple[FilePart | None, str]:
    """Return the parser of the file part if the body is a form, and the declared media type."""
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("", "identity"):
        detail = f"Content-Encoding {encoding[:40]!r} is not supported; send plain bytes."
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


async def _chunks(
    request: Request, settings: Settings, reservation: Reservation
) -> AsyncIterator[bytes]:
    limit = settings.max_body_bytes
    if (announced := announced_bytes(request)) > limit:
        raise _too_large(limit, announced)
    size = 0
    while True:
        try:
            async with asyncio.timeout(settings.body_idle_s):
                message = await request.receive()
        except TimeoutError as error:
            setting = "PUGEO_BODY_IDLE_S"
            detail = f"No byte of the body arrived for {settings.body_idle_s:g} s ({setting})."
            fields = {"limit": settings.body_idle_s, "setting": setting}
            headers = {"Connection": "close"}
            raise ProblemError(
                408, "body_timeout", detail, headers=headers, fields=fields
            ) from error
        if message["type"] == "http.disconnect":
            raise ClientDisconnectedError
        data: bytes = message.get("body", b"")
        size += len(data)
        if size > limit:
            raise _too_large(limit, size)
        reservation.add_bytes(len(data))
        if data:
            yield data
        if not message.get("more_body", False):
            return


def _too_large(limit: int, value: int) -> ProblemError:
    setting = "PUGEO_MAX_BODY_BYTES"
    detail = f"The body has {value} bytes or more; the limit is {limit}. {setting} raises it."
    fields = {"limit": limit, "value": value, "setting": setting}
    return ProblemError(413, "body_too_large", detail, fields=fields)
