# SPDX-License-Identifier: Apache-2.0
"""HEAD for every route that has GET, as pure ASGI middleware (see `middleware`)."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["AnswerHead"]


class _AnsweredError(OSError):
    """The headers are sent, so nothing of the body is needed."""


class AnswerHead:
    """Middleware that answers HEAD with the headers of GET.

    The route stops at the first piece of its body, so that a stream ends and no file is read.

    Args:
        app: the application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one ASGI event."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        sent = False

        async def send_head(message: Message) -> None:
            nonlocal sent
            if message["type"] == "http.response.start":
                await send(message)
            elif not sent:
                sent = True
                await send({"type": "http.response.body", "body": b""})
            if sent:
                raise _AnsweredError

        # A copy: the server sends no body because its own scope says HEAD.
        inner = {**scope, "method": "GET"}
        try:
            await self._app(inner, receive, send_head)
        except* _AnsweredError:
            pass
        finally:
            if "route" in inner:
                scope["route"] = inner["route"]
