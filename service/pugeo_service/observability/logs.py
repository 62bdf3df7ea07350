# SPDX-License-Identifier: Apache-2.0
"""Configuration of logs: one event per line, as JSON or for a terminal."""

import logging
import sys
from typing import Any

import structlog

from pugeo_service.observability.tracing import add_trace

__all__ = ["configure"]

# Members of an event that have several lines.
_LINES = frozenset({"exception", "stack"})


def configure(log_format: str, level: str) -> None:
    """Send structlog's and the standard library's logs to stderr in one form.

    Args:
        log_format: ``json``, ``console``, or ``auto``, which is console if stderr is a terminal.
        level: ``debug``, ``info``, ``warning`` or ``error``.
    """
    if log_format == "auto":
        log_format = "console" if sys.stderr.isatty() else "json"
    shared: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.stdlib.ExtraAdder(),
        _without_colors,
        add_trace,
    ]
    last: list[Any]
    # Tracebacks without values of variables, which may contain data of users.
    if log_format == "json":
        tracebacks = structlog.tracebacks.ExceptionDictTransformer(show_locals=False)
        render = structlog.processors.ExceptionRenderer(tracebacks)
        last = [render, structlog.processors.JSONRenderer()]
    else:
        plain = structlog.dev.plain_traceback
        # Tracebacks first, so that the texts of errors are escaped too.
        last = [
            structlog.processors.format_exc_info,
            _printable,
            structlog.dev.ConsoleRenderer(exception_formatter=plain),
        ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
    # Handlers of these libraries would print each line a second time.
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "distributed"):
        logger = logging.getLogger(name)
        logger.handlers = []
        logger.propagate = True


def _without_colors(_logger: Any, _method: str, event: dict[str, Any]) -> dict[str, Any]:
    """Remove uvicorn's copy of the message with colours."""
    event.pop("color_message", None)
    return event


def _printable(_logger: Any, _method: str, event: dict[str, Any]) -> dict[str, Any]:
    """Escape characters that a terminal would obey; paths and error texts come from clients."""
    return {key: _escaped(value, "\n" if key in _LINES else "") for key, value in event.items()}


def _escaped(value: Any, kept: str) -> Any:
    if value is None or isinstance(value, bool | int | float):
        return value
    return "".join(
        each if each.isprintable() or each in kept else each.encode("unicode_escape").decode()
        for each in str(value)
    )
