"""A move is guarded: the arm comes to rest first, whatever fails, and then all is told.

A move locks the arm when it begins and unlocks it at its end alone, so that no way out leaves it
free to move on. However else it ends (a limit, a full disk, Ctrl-C, a mistake of the program),
nothing is sent to the arm any more, so that it holds; where its link and safety system allow, it
retreats; only then are readings written and errors raised, and what fails on the way is added to
what is told. Signals wait for the next reading meanwhile.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from tpcd.errors import RobotError, TpcdError
from tpcd.robot.held_signals import HeldSignals
from tpcd.robot.preflight import FreeAir
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo

HOLDS, RETREATED = "the arm holds its place", "the arm has retreated"
Made = TypeVar("Made")


class Guard:
    """The moves of one arm, one at a time; `folder` takes their readings."""

    def __init__(self, folder: Path) -> None:
        """No arm is there yet: `servo` is None until it can be moved."""
        self.servo: Servo | None = None
        self.signals = HeldSignals()
        self.at_rest: str | None = None
        """How the arm was left after a stop; None while it may be moved."""
        self.row = 0
        """The row that is being measured, for the record."""
        self.in_air: FreeAir | None = None
        """What was read in free air at the end of the retreat, where it was."""
        self._folder, self._left, self._leaving = folder, False, threading.RLock()
        self._retreat: RawRecord | None = None
        """Readings of the retreat, until they are kept."""

    def move(self, name: str, steps: Callable[[], Made], **about: Any) -> Made:
        """Make a move and record it as `name` with what is said `about` it.

        Raises RobotError for what the world does, with how the arm was left; KeyboardInterrupt
        likewise; mistakes of the program as they are.
        """
        if self.at_rest is not None:
            raise RobotError(f"{self.at_rest} since it was stopped; connect anew to move it")
        if self.servo is None:
            raise RobotError("the arm is not connected; start it first")
        record = self.servo.record = RawRecord()
        about = {"row": self.row, **about}
        self.at_rest = HOLDS
        try:
            self.signals.hold()
            made = steps()
            self.signals.release()
            record.write(self._folder, name, {**about, "ended": "done"})
            self.at_rest = None
            return made
        except BaseException as error:
            told = self._broken_off(error, record, name, about)
            if told is None:
                raise
            raise told from error

    def stop(self) -> None:
        """Hold at once, and retreat where that is safe; nothing if it has been done.

        Ctrl-C ends the retreat, and is raised once the arm is at rest.
        """
        if self._left:
            return
        self.signals.hold()
        ended = self._leave()
        self._keep_retreat()
        self.signals.release()
        if isinstance(ended, KeyboardInterrupt):
            raise ended

    def refusal(self, problem: str, resumable: bool = True) -> RobotError:
        """Stop the arm; the error with which it is given up."""
        self.stop()
        return RobotError(f"{problem}; {self.at_rest}", resumable)

    def _broken_off(
        self, error: BaseException, record: RawRecord, name: str, about: dict[str, Any]
    ) -> BaseException | None:
        """Bring the arm to rest, then keep the readings; what is to be told, None for mistakes of
        the program."""
        self.signals.hold()
        self._leave()
        with suppress(KeyboardInterrupt):  # The error that is told ends the run as well.
            self.signals.release()
        self._keep_retreat()
        unkept = self._keep(record, name, {**about, "ended": _line(error)})
        if isinstance(error, KeyboardInterrupt):
            return KeyboardInterrupt(f"{self.at_rest}{unkept}")
        if isinstance(error, (TpcdError, OSError)):
            told = f"{_line(error)}; {self.at_rest}{'' if _line(error) in unkept else unkept}"
            return RobotError(told, getattr(error, "resumable", True))
        return None

    def _leave(self) -> BaseException | None:
        """Send nothing any more, and retreat where that is safe; what ended the retreat early.
        Nothing is written, and nothing raised but what strikes between two statements."""
        servo = self.servo
        if servo is not None:
            servo.halted = True
        with self._leaving:
            if self._left:
                return None
            self.at_rest, ended = HOLDS, None
            try:
                if servo is not None and servo.state is not None and servo.link.alive:
                    servo.record = self._retreat = RawRecord()
                    self.in_air = servo.retreat()
                    self.at_rest = RETREATED
            except BaseException as error:
                ended = error
                self.at_rest = f"{HOLDS}, its way back not being free ({_line(error)})"
            self._left = True
            return ended

    def _keep_retreat(self) -> None:
        with self._leaving:
            record, self._retreat = self._retreat, None
        if record is not None:
            about = {"row": self.row, "ended": self.at_rest}
            self.at_rest = f"{self.at_rest}{self._keep(record, 'retreat', about)}"

    def _keep(self, record: RawRecord, name: str, about: dict[str, Any]) -> str:
        """Write readings; what kept them from it, to be added to a message."""
        try:
            record.write(self._folder, name, about)
        except BaseException as error:
            return f"; {name} was not kept ({_line(error)})"
        return ""


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
