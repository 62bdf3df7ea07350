# SPDX-License-Identifier: Apache-2.0
"""Progress where stderr is no terminal."""

import pytest

from pugeo_model.cli import display
from pugeo_model.cli.display import Display


def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    """A line says the stage, the share that is done, and the time left once it can be told."""
    with Display(interval_s=0.0) as shown:
        shown.update("read", 0.0)
        shown.update("predict", 0.5)
        shown.update("finish", 1.0)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "read: 0%"
    assert lines[1] == "predict: 50%, about 0 s left"
    assert lines[2] == "finish: 100%"


def test_not_more_often_than_it_should(capsys: pytest.CaptureFixture[str]) -> None:
    """Between two lines there is a pause, and quiet says nothing at all."""
    with Display(interval_s=1e6) as slow, Display(quiet=True, interval_s=0.0) as silent:
        for part in (0.1, 0.2, 0.3):
            slow.update("read", part)
            silent.update("read", part)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("elapsed", "fraction", "words"),
    [(30, 0.25, "90 s"), (300, 0.25, "15 min"), (30, 0.01, ""), (30, 1.0, ""), (30, 0.0, "")],
)
def test_the_time_left(elapsed: float, fraction: float, words: str) -> None:
    """It is what the rest takes at the speed so far."""
    assert display._left(elapsed, fraction) == (words and f", about {words} left")


def test_lines_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """Long names are not wrapped, and brackets in names are no markup."""
    line = "error: " + "folder/" * 40 + "[red]scan[/red].ply"
    display.say(line, style="red")
    assert capsys.readouterr().err == f"{line}\n"
