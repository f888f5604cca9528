"""The line below what a long command prints."""

from __future__ import annotations

import io
import sys

import pytest

from tpcd.commands.work_line import WorkLine


class Terminal(io.StringIO):
    """A text that claims to be a terminal."""

    def isatty(self) -> bool:
        """It does."""
        return True


def test_a_terminal_shows_what_is_done_below_what_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(sys, "stderr", screen)
    with WorkLine() as line:
        line.begin("fit of floor_tilt")
        line.tell("round 1: floor_tilt accepted")
        line.begin("look at payload")
    first, told, last = screen.getvalue().partition("round 1: floor_tilt accepted\n")
    assert "00:00 fit of floor_tilt" in first and told
    # What was shown is wiped before a line is told, and once all is done.
    assert first.rpartition("\r")[2] == "" and first.split("\r")[-2].isspace()
    assert "fit of floor_tilt" in last and "look at payload" in last.split("\r")[-3]
    assert last.split("\r")[-2].isspace() and last.endswith("\r")


def test_elsewhere_only_what_is_told_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with WorkLine() as line:
        line.begin("fit of floor_tilt")
        line.tell("round 1")
    assert capsys.readouterr() == ("round 1\n", "")
