"""Whatever fails in a move, the arm comes to rest first: every call, a full disk, what is between.

Ctrl-C is in test_robot_interrupts.py.
"""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import torch
from robot_bench import (
    PRESSED,
    PRESSING,
    STATED_TIME,
    Springy,
    check_rest,
    command,
    pressing,
    raw_of,
    wired_arm,
)

import tpcd.files
from tpcd.belief.paper import PaperSettings
from tpcd.commands import exploration_run
from tpcd.data.episode import Episode
from tpcd.errors import RobotError
from tpcd.exploration import Estimator, explore
from tpcd.policies.protocol import Choice, Situation
from tpcd.robot import servo as servo_module
from tpcd.robot.link import Link
from tpcd.robot.protocol import stopped_first
from tpcd.robot.raw import RawRecord
from tpcd.robot.ur import UniversalRobot
from tpcd.shape.checkpoint import load_prior

pytestmark = pytest.mark.usefixtures("types_unchecked")

FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture(autouse=True)
def arriving_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm here is where it is sent: nothing to wait for at the end of a ramp."""
    monkeypatch.setattr(servo_module, "ARRIVING", 0.03)


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


def test_letting_go_of_an_arm_leaves_what_it_pressed_on(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    with pytest.raises(ZeroDivisionError), arm:
        arm.settle(PRESSING)
        assert link.force > 1.05
        _ = 1 / 0
    assert arm.at_rest == "the arm has retreated" and link.force == 0.0 and not link.alive


def test_letting_go_of_an_arm_that_does_not_come_away_is_an_error(tmp_path: Path) -> None:
    arm, link = pressing(tmp_path)
    servo = arm._guard.servo
    assert servo is not None
    servo.ramp_to = Counted(0, RobotError("met 12 N")).around(servo.ramp_to, "ramp", link)
    with pytest.raises(RobotError, match="holds its place, its way back not being free.*12 N"), arm:
        pass
    assert not link.alive


def test_ctrl_c_while_the_retreat_is_written_is_not_lost(tmp_path: Path) -> None:
    arm, _ = pressing(tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    write = RawRecord.write
    try:
        with pytest.MonkeyPatch.context() as patch:

            def struck(*arguments: Any) -> Any:
                signal.raise_signal(signal.SIGINT)
                return write(*arguments)

            patch.setattr(RawRecord, "write", struck)
            with pytest.raises(KeyboardInterrupt):
                arm.stop()
    finally:
        signal.signal(signal.SIGINT, before)
    assert arm.at_rest == "the arm has retreated" and (tmp_path / "retreat.parquet").is_file()


def test_a_controller_that_went_away_between_two_moves_is_not_waited_for() -> None:
    """Its client serves the last reading once more, and then commands would wait for minutes."""

    class Gone(Link):
        def __init__(self) -> None:
            self.alive, self._left = True, 1

        def next_sample(self) -> Any:
            self._left -= 1
            if self._left < 0:
                self.alive = False
                raise RobotError("no new reading")

        @property
        def _control(self) -> Any:
            raise AssertionError("a command that waits")

    link = Gone()
    with pytest.raises(RobotError, match="no new reading"):
        link.stop()
    link.stop()


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
