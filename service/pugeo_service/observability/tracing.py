# SPDX-License-Identifier: Apache-2.0
"""OpenTelemetry traces, sent to ``OTEL_EXPORTER_OTLP_ENDPOINT``.

FastAPI makes the span of each request as a child of the caller's ``traceparent``; this module adds
the spans of its stages. Without that variable OpenTelemetry's API does nothing, and neither its SDK
nor its exporter is imported.
"""

import importlib.util
import os
import time
from collections.abc import Iterator, Mapping
from typing import Any

from fastapi.telemetry import TelemetryConfig
from opentelemetry import trace
from starlette.types import Scope

from pugeo_model.install import install_hint

__all__ = ["StageSpans", "add_trace", "configuration", "missing_extra", "tag"]

_tracer = trace.get_tracer("pugeo")
_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_UNTRACED = ("/health", "/metrics", "/docs")
_NS = 1e9


def _wanted() -> bool:
    return any(os.environ.get(name) for name in _ENDPOINTS)


def missing_extra() -> str | None:
    """Return an installation hint if traces are configured but cannot be sent, else ``None``."""
    if _wanted() and importlib.util.find_spec("opentelemetry.exporter") is None:
        return f"OTEL_EXPORTER_OTLP_ENDPOINT is set; to send traces, {install_hint('otel')}"
    return None


def configuration() -> TelemetryConfig:
    """Return FastAPI's configuration: spans of requests, but neither its metrics nor its logs."""
    if _wanted():
        os.environ.setdefault("OTEL_SERVICE_NAME", "pugeo")
    return TelemetryConfig(
        auto_configure=_wanted(),
        tracing=True,
        metrics=False,
        # Records of exceptions contain their messages, which may quote data of users.
        logs=False,
        operation_spans=False,
        exclude=_is_untraced,
    )


def _is_untraced(scope: Scope) -> bool:
    return str(scope.get("path", "")).startswith(_UNTRACED)


def tag(**attributes: str | int) -> None:
    """Add attributes ``pugeo.<name>`` to the span of the current request."""
    span = trace.get_current_span()
    for name, value in attributes.items():
        span.set_attribute(f"pugeo.{name}", value)


def add_trace(_logger: Any, _method: str, event: dict[str, Any]) -> dict[str, Any]:
    """Add the trace id to a log event; a structlog processor."""
    context = trace.get_current_span().get_span_context()
    if context.is_valid:
        event["trace_id"] = trace.format_trace_id(context.trace_id)
    return event


class StageSpans:
    """Spans of the stages of a run, as children of the current span."""

    def __init__(self) -> None:
        self._begun: list[tuple[str, int]] = []

    def on_stage(self, stage: str) -> None:
        """Record the begin of a stage, which is the end of the previous one."""
        self._begun.append((stage, time.time_ns()))

    def finish(self, seconds: Mapping[str, float] | None = None) -> None:
        """Make the spans.

        Args:
            seconds: seconds of stages from the result of the run, for ``queue`` and ``read``,
                which precede ``prepare`` without a call of their own; ``None`` after an error.
        """
        for name, start, end in self._intervals(seconds or {}, time.time_ns()):
            _tracer.start_span(name, start_time=start).end(end)

    def _intervals(self, seconds: Mapping[str, float], now: int) -> Iterator[tuple[str, int, int]]:
        ends = [start for _, start in self._begun[1:]] + [now]
        for (stage, start), end in zip(self._begun, ends, strict=True):
            begin = start
            if stage == "prepare":
                for earlier in ("queue", "read"):
                    stop = min(end, begin + int(_NS * max(0.0, seconds.get(earlier, 0.0))))
                    if stop > begin:
                        yield earlier, begin, stop
                    begin = stop
            yield stage, begin, end
