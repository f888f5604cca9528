"""Whatever fails in a move, the arm comes to rest first: every call, every line, a full disk."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import torch
from robot_bench import Springy, command, raw_of, wired_arm

import tpcd.files
from tpcd.belief.paper import PaperSettings
from tpcd.commands import exploration_run
from tpcd.data.episode import Episode
from tpcd.errors import RobotError
from tpcd.exploration import Estimator, explore
from tpcd.policies.protocol import Choice, Situation
from tpcd.robot import guard, held_signals, raw, ur
from tpcd.robot import link as link_module
from tpcd.robot import servo as servo_module
from tpcd.robot.admittance import at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.held_signals import HeldSignals, kill_as_ctrl_c
from tpcd.robot.protocol import stopped_first
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo
from tpcd.robot.settling import SettlingSettings
from tpcd.robot.ur import UniversalRobot
from tpcd.shape.checkpoint import load_prior

TRACED = [module.__file__ for module in (guard, held_signals, link_module, raw, servo_module, ur)]
"""What these call is arithmetic, a part of their lines."""
STATED_TIME = 2.0
"""Within which an arm is away from what it touched (tpcd/robot/README.md) [s]."""
PRESSED = (0.1, -5e-4, 0.0)
"""Where the arm stands when a move begins: in the floor by 1 N [m, m, rad]."""
PRESSING = command(0.1, -0.013)
"""A command that takes a short way further down."""
FULL = OSError(errno.ENOSPC, "No space left on device")


def pressing(folder: Path, **stated: Any) -> tuple[UniversalRobot, Springy]:
    """An arm between two moves that presses on the floor with 1 N."""
    link = Springy(PRESSED)
    stated = {"surface_mm_per_10n": 5.0, "retreat": 0.003, "still_time": 0.3, **stated}
    settings = ArmSettings("springy", **stated)
    arm = UniversalRobot(settings, folder, lambda _: True)
    arm._link = link
    servo = Servo(settings, link, link.frame, RawRecord(), arm._guard.signals)
    servo.state = at_rest(np.array(PRESSED), np.array([0.0, 1.0, 0.0]))
    servo.settling = SettlingSettings(window=0.08)
    servo._command = np.array(PRESSED) - (0.0, 0.01, 0.0)
    arm._guard.servo = servo
    return arm, link


class Counted:
    """Calls that are counted; the `failing`-th raises `error`, and so do later ones of the same
    function where it `lasts`."""

    def __init__(self, failing: int = -1, error: BaseException = FULL, lasts: bool = False) -> None:
        self.names: list[str] = []
        self.failed_at: float | None = None
        self._failing, self._error, self._lasts = failing, error, lasts
        self._name: str | None = None

    def around(self, call: Callable[..., Any], name: str, link: Springy) -> Callable[..., Any]:
        def counted(*arguments: Any, **named: Any) -> Any:
            self.names.append(name)
            if len(self.names) - 1 == self._failing:
                self._name, self.failed_at = name, link.time
                raise self._error
            if self._lasts and name == self._name:
                raise self._error
            return call(*arguments, **named)

        return counted


@contextmanager
def counting(link: Springy, arm: UniversalRobot, counted: Counted) -> Iterator[None]:
    """All that a move calls outside of its own arithmetic is counted."""
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in (
            (link, "next_sample"), (link, "servo"), (link, "zero_sensor"), (link, "payload"),
            (arm, "_confirm"), (RawRecord, "add"), (pyarrow.parquet, "write_table"),
            (os, "replace"), (Path, "mkdir"), (tpcd.files, "write_text"),
        ):  # fmt: skip
            patch.setattr(owner, name, counted.around(getattr(owner, name), name, link))
        yield


def check_rest(arm: UniversalRobot, link: Springy, force: float) -> None:
    """The arm is locked, nothing moves it, and it presses no more than before."""
    sent, target = link.sent, link.target
    assert arm.at_rest is not None
    with pytest.raises(RobotError, match="connect anew"):
        arm.settle(command(0.1, 0.0))
    arm.stop()
    assert link.sent == sent and link.target is target
    assert link.force <= force + 1e-9


def errors() -> list[BaseException]:
    return [OSError(*FULL.args), RuntimeError("a mistake"), KeyboardInterrupt()]


def test_every_call_of_a_move_may_fail_and_the_arm_is_at_rest(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    whole = Counted()
    with counting(link, arm, whole):
        arm.settle(PRESSING)
    assert arm.at_rest is None and link.force > 1.05
    assert {"next_sample", "servo", "add", "write_table", "replace", "mkdir"} == set(whole.names)
    for failing, name in enumerate(whole.names):
        # In a loop of three calls each reading fails in another way; what is called once, in all.
        often = whole.names.count(name) > 3
        kinds = errors()
        for error in kinds[(failing // 3 + failing) % 3 :][:1] if often else kinds:
            arm, link = pressing(tmp_path / f"{failing}")
            counted = Counted(failing, error)
            with (
                counting(link, arm, counted),
                pytest.raises((RobotError, RuntimeError, KeyboardInterrupt)) as raised,
            ):
                arm.settle(PRESSING)
            assert counted.failed_at is not None, failing
            assert link.time - counted.failed_at < STATED_TIME
            check_rest(arm, link, 0.0)
            if isinstance(error, RuntimeError):
                assert raised.value is error
            else:
                assert "the arm has retreated" in str(raised.value)
                assert isinstance(raised.value, (RobotError, KeyboardInterrupt))
            if isinstance(error, OSError):
                assert "No space left on device" in str(raised.value)


def test_calls_of_a_start_may_fail_and_the_arm_is_at_rest(tmp_path: Path) -> None:
    """The first and last of each kind, and every 299th."""

    def standing(folder: Path) -> tuple[UniversalRobot, Springy]:
        arm, _ = pressing(folder, origin=(0.4, 0.0, 0.1))
        link = arm._link = Springy((0.1, 0.02, 0.0))
        return arm, link

    arm, link = standing(tmp_path)
    whole = Counted()
    with counting(link, arm, whole):
        arm.start()
    names = whole.names
    assert {"zero_sensor", "payload", "_confirm", "write_text"} < set(names)
    ends = {names.index(name) for name in set(names)}
    ends |= {len(names) - 1 - names[::-1].index(name) for name in set(names)}
    for failing in sorted(ends | set(range(0, len(names), 299))):
        for error in errors():
            arm, link = standing(tmp_path / f"{failing}")
            counted = Counted(failing, error)
            with counting(link, arm, counted), pytest.raises(BaseException) as raised:
                arm.start()
            assert type(raised.value) in (RobotError, type(error))
            if names[failing] in ("payload", "_confirm") or failing == names.index("next_sample"):
                assert link.sent == 0, "nothing has moved yet"
                arm.stop()
            assert link.time - (counted.failed_at or 0.0) < STATED_TIME
            check_rest(arm, link, 0.0)


def test_a_disk_that_stays_full_hides_neither_the_limit_nor_itself(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path, stop_force=6.0, retreat=0.01)
    counted = Counted(0, lasts=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pyarrow.parquet, "write_table", counted.around(lambda *_: None, "write", link)
        )
        with pytest.raises(RobotError) as raised:
            arm.settle(command(0.1, -0.08))
    told = str(raised.value)
    assert "beyond the limit of 6 N; the arm has retreated" in told
    assert told.index("limit") < told.index("No space left on device") and "\n" not in told
    assert "row_001 was not kept" in told and "retreat was not kept" in told
    assert len(counted.names) == 2
    check_rest(arm, link, 0.0)


def test_a_disk_that_is_full_at_the_end_of_a_move_is_told_with_its_file(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", Counted(0, lasts=True).around(os.replace, "replace", link))
        with pytest.raises(RobotError, match=r"row_001.parquet: cannot be written: No space left"):
            arm.settle(PRESSING)
    check_rest(arm, link, 0.0)
    assert not list(tmp_path.glob("*"))


def test_what_a_move_has_read_is_kept_where_only_its_first_writing_failed(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", Counted(0).around(os.replace, "replace", link))
        with pytest.raises(RobotError):
            arm.settle(PRESSING)
    columns, about = raw_of(tmp_path, "row_001")
    assert len(columns["stamp"]) > 20 and "No space left on device" in about["ended"]


def test_a_second_failure_in_the_retreat_leaves_the_arm_standing_and_both_told(
    tmp_path: Path,
) -> None:
    for second in errors():
        arm, link = pressing(tmp_path, stop_force=6.0, retreat=0.01)
        servo = arm._guard.servo
        assert servo is not None
        patch = pytest.MonkeyPatch()
        patch.setattr(servo, "ramp_to", Counted(0, second).around(servo.ramp_to, "ramp", link))
        with pytest.raises(RobotError, match="beyond the limit of 6 N; the arm holds its place"):
            arm.settle(command(0.1, -0.08))
        check_rest(arm, link, 9.0)


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


@pytest.fixture(autouse=True)
def arriving_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm here is where it is sent: nothing to wait for at the end of a ramp."""
    monkeypatch.setattr(servo_module, "ARRIVING", 0.03)


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


def test_signals_are_held_in_the_main_thread_alone(ctrl_c: None) -> None:
    found: list[object] = []

    def elsewhere() -> None:
        signals = HeldSignals()
        signals.hold()
        found.append(signal.getsignal(signal.SIGINT))
        signals.release()

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


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


def test_letting_go_of_an_arm_leaves_what_it_pressed_on(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    with pytest.raises(ZeroDivisionError), arm:
        arm.settle(PRESSING)
        assert link.force > 1.05
        _ = 1 / 0
    assert arm.at_rest == "the arm has retreated" and link.force == 0.0 and not link.alive


@pytest.mark.parametrize("fails", ["on_row", "estimator", "policy"])
def test_what_fails_between_two_moves_stops_the_arm_first(
    fails: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, link = pressing(tmp_path)
    start = torch.tensor(PRESSED, dtype=torch.float64)
    std = torch.full((6,), 1e-3, dtype=torch.float64)
    stiffness = command(100.0, 100.0, 50.0)
    monkeypatch.setattr(
        arm, "start", lambda: Episode(start[None], start[None], 0 * start[None], stiffness, std)
    )
    pressed: list[float] = []

    def failing(*_: object) -> Any:
        pressed.append(link.force)
        raise OSError(*FULL.args)

    class Further:
        def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
            return failing() if fails == "policy" else Choice(PRESSING)

    if fails == "estimator":
        monkeypatch.setattr(Estimator, "steps", failing)
    estimator = Estimator(load_prior("ycb21-z2"), "paper", paper=PaperSettings(particles=20))
    steps = explore(arm, Further(), estimator, 0, on_row=failing if fails == "on_row" else None)
    with pytest.raises(OSError, match="No space left"):
        next(steps)
    assert pressed[0] > 0.9 and link.force == 0.0
    assert arm.at_rest == "the arm has retreated"


def test_who_has_enough_of_the_moves_may_still_have_the_arm() -> None:
    stopped: list[bool] = []

    def moves() -> Iterator[int]:
        with stopped_first(lambda: stopped.append(True)):
            yield 1
            yield 2

    steps = moves()
    assert next(steps) == 1
    del steps
    assert not stopped


def test_a_run_lets_go_of_the_arm_before_its_files_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    class Run:
        def __init__(self, *_: object) -> None:
            pass

        def __enter__(self) -> Run:
            return self

        def __exit__(self, *_: object) -> None:
            order.append("files")

    def steps() -> Iterator[Any]:
        raise OSError(*FULL.args)
        yield

    monkeypatch.setattr(exploration_run, "EstimationRun", Run)
    stopping = exploration_run.Stopping(3)
    with pytest.raises(OSError, match="No space left"):
        exploration_run.run_exploration(
            steps(), stopping, "", tmp_path, let_go=lambda: order.append("arm")
        )
    assert order == ["arm", "files"]


@pytest.mark.parametrize(("reading", "kind"), [(3, 0), (60, 1), (150, 2)])
def test_on_the_emulator_too_the_arm_comes_away(reading: int, kind: int, tmp_path: Path) -> None:
    arm, controller = wired_arm(tmp_path, arm={"still_time": 0.5})
    x, z, _ = arm.start().poses[0].tolist()
    arm.settle(command(x, z - 0.04))
    assert controller._sense()[2] > 1.0
    link = arm._link
    assert link is not None
    read, left = link.next_sample, iter(range(reading - 1))

    def failing() -> Any:
        assert arm._guard.servo is not None
        if next(left, None) is None and not arm._guard.servo.halted:
            raise errors()[kind]
        return read()

    link.next_sample = failing  # type: ignore[method-assign]
    began = controller.time
    with pytest.raises((RobotError, RuntimeError, KeyboardInterrupt)):
        arm.settle(command(x + 0.02, z - 0.06))
    assert arm.at_rest == "the arm has retreated"
    assert controller.time - began < reading / 125.0 + STATED_TIME
    for _ in range(50):
        controller.advance()
    assert np.abs(controller._speed).max() == 0.0
    assert np.abs(controller._sense()[:3]).max() == 0.0
