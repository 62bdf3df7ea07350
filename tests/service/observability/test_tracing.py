# SPDX-License-Identifier: Apache-2.0
"""OpenTelemetry traces of requests and their stages."""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from starlette.testclient import TestClient

from pugeo_service.http.middleware import RequestContext
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Readings, Telemetry
from pugeo_service.observability.tracing import StageSpans

TRACE_ID = "0af7651916cd43dd8448eb211c80319c"
PARENT = {"traceparent": f"00-{TRACE_ID}-b7ad6b7169203331-01"}
SECOND = 1_000_000_000


@pytest.fixture
def spans(monkeypatch: pytest.MonkeyPatch) -> Iterator[InMemorySpanExporter]:
    """Exporter of the spans of a test."""
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    monkeypatch.setattr(tracing, "_tracer", provider.get_tracer("pugeo"))
    yield exporter
    provider.shutdown()


def served() -> TestClient:
    """An application with tracing, a route with stages, and a probe."""
    app = FastAPI(telemetry=tracing.configuration())
    telemetry = Telemetry(lambda: Readings(0, 0, 0, 0, 0, 0), "1")
    app.add_middleware(RequestContext, telemetry=lambda: telemetry)

    @app.post("/upsample")
    async def upsample() -> dict[str, str]:
        stages = StageSpans()
        for stage in ("prepare", "predict", "finish"):
            stages.on_stage(stage)
        stages.finish()
        return tracing.add_trace(None, "", {})

    @app.get("/health/live")
    async def live() -> str:
        return "alive"

    return TestClient(app)


def test_a_request_and_its_stages(spans: InMemorySpanExporter) -> None:
    """Stages are children of the request, which is a child of the caller's span."""
    answer = served().post("/upsample?R=2", headers={**PARENT, "X-Request-ID": "mine"})
    assert answer.json() == {"trace_id": TRACE_ID}
    found = {span.name: span for span in spans.get_finished_spans()}
    assert set(found) == {"POST /upsample", "prepare", "predict", "finish"}
    request = found["POST /upsample"]
    assert request.parent is not None
    assert trace.format_span_id(request.parent.span_id) == "b7ad6b7169203331"
    assert trace.format_trace_id(request.context.trace_id) == TRACE_ID
    assert request.attributes is not None
    assert request.attributes["pugeo.request_id"] == "mine"
    for stage in ("prepare", "predict", "finish"):
        parent = found[stage].parent
        assert parent is not None
        assert parent.span_id == request.context.span_id


def test_probes_are_not_traced(spans: InMemorySpanExporter) -> None:
    """Probes have no spans."""
    served().get("/health/live", headers=PARENT)
    assert spans.get_finished_spans() == ()


def test_when_stages_begin_and_end(
    spans: InMemorySpanExporter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each stage ends where the next begins; queue and read are parts of the first."""
    now = 0
    monkeypatch.setattr(time, "time_ns", lambda: now)
    stages = StageSpans()
    for second, stage in ((10, "prepare"), (20, "predict"), (50, "finish")):
        now = second * SECOND
        stages.on_stage(stage)
    now = 60 * SECOND
    stages.finish({"queue": 4.0, "read": 1.0, "prepare": 5.0, "predict": 30.0})
    found = [
        (span.name, (span.start_time or 0) // SECOND, (span.end_time or 0) // SECOND)
        for span in spans.get_finished_spans()
    ]
    assert found == [
        ("queue", 10, 14), ("read", 14, 15), ("prepare", 15, 20), ("predict", 20, 50),
        ("finish", 50, 60),
    ]  # fmt: skip


def run(code: str, root: Path, **environment: str) -> str:
    """Run code in a fresh interpreter with nothing but these variables."""
    paths = [str(root / home) for home in ("model", "service")]
    command = [sys.executable, "-c", f"import sys; sys.path[:0] = {paths}; {code}"]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment
    ).stdout


@pytest.mark.slow
def test_nothing_is_loaded_unless_asked_for(root: Path) -> None:
    """Without the variable neither SDK nor exporter is imported."""
    code = (
        "from pugeo_service import server; from pugeo_service.observability import tracing; "
        "print(tracing.configuration()['auto_configure'], "
        "[m for m in sys.modules if m.startswith(('opentelemetry.sdk', 'opentelemetry.exp'))])"
    )
    assert run(code, root) == "False []\n"
    asked = run(code, root, OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:1")
    assert asked == "True []\n"


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """If traces are configured but cannot be sent, the hint names the extra."""
    assert tracing.missing_extra() is None
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318")
    assert tracing.missing_extra() is None
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert "pugeo[otel]" in (tracing.missing_extra() or "")
