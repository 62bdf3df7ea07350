# SPDX-License-Identifier: Apache-2.0
"""Logs are one JSON object a line, name the request, and hold nobody's data."""

import json
import logging
from collections.abc import Iterator
from typing import Any

import pytest
import structlog

from pugeo_service.observability import logs


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """Leave logging as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    structlog.reset_defaults()


def fail(points: list[str]) -> None:
    """Raise with somebody's data in a variable."""
    copied = list(points)
    raise KeyError(len(copied))


def logged(form: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What an unexpected error writes."""
    logs.configure(form, "info")
    logger = structlog.stdlib.get_logger("test")
    with structlog.contextvars.bound_contextvars(request_id="abc"):
        try:
            fail(["private-1", "private-2"])
        except KeyError:
            logger.exception("unexpected error")
    return capsys.readouterr().err


@pytest.mark.parametrize("form", ["json", "console"])
def test_no_variable_is_logged(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A traceback tells where, and nothing of what was in hand there."""
    text = logged(form, capsys)
    assert "KeyError" in text
    assert "test_logs.py" in text
    assert "private" not in text.replace('["private-1", "private-2"]', "")


def test_json(capsys: pytest.CaptureFixture[str]) -> None:
    """One line, one object: event, level, time, request, and the frames of the error."""
    (line,) = logged("json", capsys).splitlines()
    entry: dict[str, Any] = json.loads(line)
    assert (entry["event"], entry["level"], entry["request_id"]) == (
        "unexpected error",
        "error",
        "abc",
    )
    assert entry["timestamp"].endswith("Z")
    (error,) = entry["exception"]
    assert error["exc_type"] == "KeyError"
    assert [frame["name"] for frame in error["frames"]][-1] == "fail"
    assert not [frame for frame in error["frames"] if frame.get("locals")]


def test_foreign_logs_have_the_same_form(capsys: pytest.CaptureFixture[str]) -> None:
    """What libraries log is JSON too."""
    logs.configure("json", "info")
    extra = {"color_message": "\x1b[31mcareful\x1b[0m: %d", "port": 80}
    logging.getLogger("uvicorn.error").warning("careful: %d", 7, extra=extra)
    entry = json.loads(capsys.readouterr().err)
    assert (entry["event"], entry["level"], entry["logger"]) == (
        "careful: 7",
        "warning",
        "uvicorn.error",
    )
    assert entry["port"] == 80
    assert "color_message" not in entry


def test_machines_get_json(capsys: pytest.CaptureFixture[str]) -> None:
    """Where stderr is no terminal, as in production, auto means JSON."""
    assert json.loads(logged("auto", capsys))["event"] == "unexpected error"
