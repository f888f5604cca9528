"""Ctrl-C, kill and other threads while an arm moves: between any two lines, and in the retreat."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from robot_bench import PRESSING, STATED_TIME, check_rest, command, pressing

from tpcd.errors import RobotError
from tpcd.robot import guard, held_signals, raw, ur
from tpcd.robot import link as link_module
from tpcd.robot import servo as servo_module
from tpcd.robot.held_signals import HeldSignals, kill_as_ctrl_c

pytestmark = pytest.mark.usefixtures("types_unchecked")

TRACED = [module.__file__ for module in (guard, held_signals, link_module, raw, servo_module, ur)]
"""What these call is arithmetic, a part of their lines."""


@pytest.fixture(autouse=True)
def arriving_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm here is where it is sent: nothing to wait for at the end of a ramp."""
    monkeypatch.setattr(servo_module, "ARRIVING", 0.03)


def lines_of(call: Callable[[], object], act: Callable[[tuple[str, int], int], None]) -> None:
    """Run a call; `act` is told of every line that is traced, and how often it came."""
    seen: dict[tuple[str, int], int] = {}

    def trace(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename not in TRACED:
            return None
        if event == "line":
            place = (frame.f_code.co_filename, frame.f_lineno)
            seen[place] = seen.get(place, 0) + 1
            act(place, seen[place])
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C as in a terminal: what runs in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("how", ["signal", "raised"])
def test_ctrl_c_at_every_line_of_a_move_ends_with_the_arm_at_rest(
    how: str, tmp_path: Path, ctrl_c: None
) -> None:
    """As a signal, the first time that each line is run, it waits for the next reading. Raised on
    the spot, the last time, it may also strike what would bring the arm to rest: then it stands,
    is locked, and is seen to by whoever lets go of it."""
    times: dict[tuple[str, int], int] = {}
    arm, _ = pressing(tmp_path)
    lines_of(lambda: arm.settle(PRESSING), lambda at, n: times.update({at: n}))
    moments = [(at, 1 if how == "signal" else last) for at, last in times.items()]
    assert len(moments) > 100
    struck = 0
    for place, count in moments:
        arm, link = pressing(tmp_path / "again")
        done = []

        def strike(at: tuple[str, int], n: int) -> None:
            if not done and at == place and n == count:  # noqa: B023
                done.append(link.time)  # noqa: B023
                sys.settrace(None)
                if how == "signal":
                    signal.raise_signal(signal.SIGINT)
                else:
                    raise KeyboardInterrupt

        with suppress(KeyboardInterrupt):
            lines_of(lambda: arm.settle(PRESSING), strike)  # noqa: B023
            raise AssertionError(f"{place} went on")
        struck += 1
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler or how == "raised"
        assert link.time - done[0] < STATED_TIME
        if link.sent == 0:  # The move had not begun.
            assert link.force <= 1.0 + 1e-9
            continue
        assert arm.at_rest is not None, place
        if how == "raised":
            arm.stop()
        check_rest(arm, link, 0.0)
    assert struck == len(moments)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_ends_the_retreat_and_the_arm_stands(tmp_path: Path, ctrl_c: None) -> None:
    arm, link = pressing(tmp_path)
    read, retreating = link.next_sample, []

    def interrupted() -> Any:
        if link.sent == 10:
            signal.raise_signal(signal.SIGINT)
        if arm._guard.servo is not None and arm._guard.servo._retreating:
            retreating.append(link.time)
            if len(retreating) == 5:
                signal.raise_signal(signal.SIGINT)
        return read()

    link.next_sample = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt, match="holds its place, its way back"):
        arm.settle(command(0.1, -0.05))
    assert len(retreating) < 8
    check_rest(arm, link, 2.0)


def test_ctrl_c_in_the_retreat_after_the_last_move_is_raised_once_the_arm_stands(
    tmp_path: Path, ctrl_c: None
) -> None:
    arm, link = pressing(tmp_path)
    read = link.next_sample

    def interrupted() -> Any:
        if link.sent == 3:
            signal.raise_signal(signal.SIGINT)
        return read()

    link.next_sample = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        arm.stop()
    assert (arm.at_rest or "").startswith("the arm holds its place")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_user_is_called_and_the_move_goes_on_if_it_returns(tmp_path: Path) -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        arm, link = pressing(tmp_path)
        read = link.next_sample

        def interrupted() -> Any:
            if link.sent == 3 and not heard:
                signal.raise_signal(signal.SIGINT)
            return read()

        link.next_sample = interrupted  # type: ignore[method-assign]
        assert arm.settle(PRESSING).settled
        assert heard == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_kill_in_a_move_is_as_ctrl_c_and_only_meanwhile(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    read = link.next_sample

    def killed() -> Any:
        if link.sent == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return read()

    link.next_sample = killed  # type: ignore[method-assign]
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with kill_as_ctrl_c(), pytest.raises(KeyboardInterrupt, match="has retreated|holds"):
            arm.settle(PRESSING)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)
    check_rest(arm, link, 1.5)


def test_signals_are_held_and_let_go_of_in_the_main_thread_alone(ctrl_c: None) -> None:
    found: list[object] = []

    def elsewhere() -> None:
        signals = HeldSignals()
        signals.hold()
        found.append(signal.getsignal(signal.SIGINT))
        held.look()
        held.release()
        signals.release()
        found.append(held._held)

    held = HeldSignals()
    held.hold()
    signal.raise_signal(signal.SIGINT)
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert found == [held._take, True]
    with pytest.raises(KeyboardInterrupt):
        held.release()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_stopping_from_another_thread_ends_the_move_there(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    read, raised = link.next_sample, []

    def slow() -> Any:
        time.sleep(1e-3)
        return read()

    link.next_sample = slow  # type: ignore[method-assign]

    def move() -> None:
        try:
            arm.settle(command(0.1, -0.05))
        except RobotError as error:
            raised.append(str(error))

    thread = threading.Thread(target=move)
    thread.start()
    while link.sent < 10:
        time.sleep(1e-3)
    arm.stop()
    thread.join()
    assert "told to stop; the arm has retreated" in raised[0]
    check_rest(arm, link, 0.0)
