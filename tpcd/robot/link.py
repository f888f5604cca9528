"""The link to a Universal Robots controller through ur_rtde, watched at every reading.

What ur_rtde does not say by itself is checked here. It goes on serving the last reading when the
controller is gone, so every reading must bring a new stamp within a few hundredths of a second.
Its commands answer with a boolean. Those that wait for the controller wait for minutes and hold
Python's interpreter lock while they do; so none of them is used while the arm moves, and none at
all once a reading was late.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from tpcd.errors import RobotError, SolverError

VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_force",
    "target_TCP_pose",
    "robot_status_bits",
    "safety_status_bits",
    "payload",
]
SAFETY_STOPS = {
    2: "protective stop",
    4: "safeguard stop",
    5: "emergency stop",
    6: "emergency stop",
    7: "emergency stop",
    8: "safety violation",
    9: "fault",
    10: "stop for safety",
}
"""Bits of safety_status_bits (RTDE guide) in which the arm does not move."""
LOOK_AHEAD, GAIN = 0.03, 500.0
"""Of servoL: the least smoothing, and a gain in the middle of its range."""


@dataclass(frozen=True)
class Sample:
    """One reading of the controller."""

    stamp: float
    """Controller time [s]."""
    tcp: Float[np.ndarray, " 6"]
    """TCP pose in the base frame, position [m] and rotation vector [rad]."""
    wrench: Float[np.ndarray, " 6"]
    """At the TCP along base axes [N, N·m]."""
    target: Float[np.ndarray, " 6"]
    """Where the servo wants the TCP."""
    received: float
    """Time of this machine, monotonic [s]."""


class Link:
    """A connected arm under remote control, its script uploaded and running."""

    def __init__(self, address: str, rate: float, stale_time: float = 0.04) -> None:
        """Connect; without a new stamp for `stale_time` [s] the link counts as lost.

        Raises RobotError where it cannot be had, SolverError without ur_rtde.
        """
        try:
            from rtde_control import RTDEControlInterface
            from rtde_receive import RTDEReceiveInterface
        except ImportError as error:
            raise SolverError("no ur_rtde here; install it: pip install tpcd[robot]") from error
        self.address, self.rate, self.stale_time = address, rate, stale_time
        self.alive = False
        """Whether commands that wait for an answer may be used."""
        self._last = 0.0
        self._receive: Any = None
        self._control: Any = None
        try:
            self._receive = RTDEReceiveInterface(address, rate, VARIABLES)
            self._control = RTDEControlInterface(address, rate)
        except (RuntimeError, ValueError) as error:
            self.disconnect()
            raise RobotError(f"{address}: {_connection_problem(str(error))}") from error
        self.alive = True

    def next_sample(self) -> Sample:
        """Wait for the next reading; raises RobotError once the link or the arm has stopped."""
        deadline = time.monotonic() + self.stale_time
        receive = self._receive
        while True:
            stamp = self._ask(receive.getTimestamp)
            if stamp != self._last:
                break
            if time.monotonic() > deadline:
                self.alive = False
                connected = "the connection stands" if receive.isConnected() else "it is cut"
                raise RobotError(
                    f"{self.address}: no new reading for {1e3 * self.stale_time:.0f} ms"
                    f" ({connected}); the arm holds its last target: see to it, then to network and"
                    " controller"
                )
            time.sleep(2e-4)
        self._last = stamp
        self._check_safety()
        return Sample(
            stamp,
            np.array(self._ask(receive.getActualTCPPose)),
            np.array(self._ask(receive.getActualTCPForce)),
            np.array(self._ask(receive.getTargetTCPPose)),
            time.monotonic(),
        )

    def payload(self) -> float:
        """Mass that the controller was told it carries [kg]."""
        return float(self._ask(self._receive.getPayload))

    def servo(self, target: Float[np.ndarray, " 6"]) -> None:
        """Give the servo its next target, a TCP pose in the base frame."""
        timing = (1.0 / self.rate, LOOK_AHEAD, GAIN)
        self._do(self._control.servoL, target.tolist(), 0.0, 0.0, *timing)

    def zero_sensor(self) -> None:
        """Take the present wrench for zero."""
        if self.alive:
            self._do(self._control.zeroFtSensor)

    def stop(self) -> None:
        """End the servo; the arm holds where it is. Raises RobotError where the link is lost, which
        may have been so since the last reading."""
        for _ in range(2 * self.alive):  # The first may be one that was served before.
            self.next_sample()
        if self.alive and self._ask(self._control.isProgramRunning):
            self._do(self._control.servoStop)

    def disconnect(self) -> None:
        """End script and connections; never raises, takes up to 6 s where the link is lost."""
        for interface in (self._control, self._receive):
            if interface is None:
                continue
            with contextlib.suppress(RuntimeError):
                if interface is self._control and self.alive and interface.isProgramRunning():
                    interface.stopScript()
            with contextlib.suppress(RuntimeError):
                interface.disconnect()
        self._control = self._receive = None
        self.alive = False

    @property
    def stopped_for_safety(self) -> str | None:
        """Why the safety system keeps the arm from moving; None where it does not."""
        bits = int(self._ask(self._receive.getSafetyStatusBits))
        found = [name for bit, name in SAFETY_STOPS.items() if bits >> bit & 1]
        return found[0] if found else None

    def _check_safety(self) -> None:
        reason = self.stopped_for_safety
        if reason is not None:
            self.alive = False
            raise RobotError(
                f"{self.address}: {reason}; see to the arm and clear it on the teach pendant"
            )

    def _ask(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """What the client answers; an error of the client is a link that is lost."""
        try:
            return call(*arguments)
        except RuntimeError as error:
            self.alive = False
            raise RobotError(
                f"{self.address}: {call.__name__} failed ({' '.join(str(error).split())}); the arm"
                " holds its last target: see to it, then to network and controller"
            ) from error

    def _do(self, call: Callable[..., Any], *arguments: Any) -> None:
        """Give a command; raises RobotError where it is refused."""
        if self._ask(call, *arguments):
            return
        self._check_safety()
        self.alive = False
        running = "runs" if self._ask(self._control.isProgramRunning) else "has ended"
        raise RobotError(
            f"{self.address}: {call.__name__} was refused, the control script {running}; look at"
            " the teach pendant's log"
        )


def _connection_problem(message: str) -> str:
    lowered = " ".join(message.split())
    if "remote control" in lowered:
        return "the arm is under local control; switch the teach pendant to remote control"
    if "already in use" in lowered:
        return (
            "registers are in use by another client; end it, and disable EtherNet/IP, PROFINET and"
            " MODBUS units in the installation"
        )
    return f"cannot connect ({lowered}); is the arm on, and the address right?"
