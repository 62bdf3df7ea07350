# SPDX-License-Identifier: Apache-2.0
"""Logs: one event a line, JSON for machines and colours for a terminal."""

import logging
import sys
from typing import Any

import structlog

from pugeo_service.observability.tracing import add_trace

__all__ = ["configure"]


def configure(log_format: str, level: str) -> None:
    """Send structlog's and the standard library's logs to stderr in one form.

    Args:
        log_format: ``json``, ``console``, or ``auto``: console where stderr is a terminal.
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
    # Frames and messages, and never the values of variables: those are somebody's points.
    if log_format == "json":
        tracebacks = structlog.tracebacks.ExceptionDictTransformer(show_locals=False)
        render = structlog.processors.ExceptionRenderer(tracebacks)
        last = [render, structlog.processors.JSONRenderer()]
    else:
        plain = structlog.dev.plain_traceback
        last = [structlog.dev.ConsoleRenderer(exception_formatter=plain)]
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
    # Their own handlers would print every line twice, in a form of their own.
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "distributed"):
        logger = logging.getLogger(name)
        logger.handlers = []
        logger.propagate = True


def _without_colors(_logger: Any, _method: str, event: dict[str, Any]) -> dict[str, Any]:
    """Drop uvicorn's second copy of its messages, painted for a terminal."""
    event.pop("color_message", None)
    return event
