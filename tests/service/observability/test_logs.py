# SPDX-License-Identifier: Apache-2.0
"""Logs: one JSON object per line, with the request id and without data of users."""

import json
import logging
import re
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
    """Raise with data of a user in a variable."""
    copied = list(points)
    raise KeyError(len(copied))


def logged(form: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Log of an unexpected error."""
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
    """A traceback contains no values of variables."""
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
    """Logs of libraries are JSON too."""
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
    """If stderr is not a terminal, auto means JSON."""
    assert json.loads(logged("auto", capsys))["event"] == "unexpected error"


def test_escape_sequences_of_clients(capsys: pytest.CaptureFixture[str]) -> None:
    """Control characters of a path or an error reach the console as text, on one line."""
    logs.configure("console", "info")
    logger = structlog.stdlib.get_logger("test")
    path = "/\x1b]0;owned\x07\x9b31m\x7f\nfake line\r\u202e"
    logger.info("request", path=path, odd=[path], word="\x1b]0;owned\x07")
    try:
        int(path)
    except ValueError:
        logger.exception("unexpected error")
    text = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().err)  # the renderer's own colours
    assert not [each for each in text if not each.isprintable() and each != "\n"]
    first, second, *_ = text.splitlines()
    assert "word=\\x1b]0;owned\\x07" in first
    assert first.count("fake line") == 2
    assert "unexpected error" in second
    assert "Traceback" in text
