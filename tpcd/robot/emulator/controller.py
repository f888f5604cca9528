"""The controller: registers, the uploaded script, the arm's servo, sensors and safety.

ur_rtde uploads a script that reads a command from input integer register 0, its arguments from
the other input registers, and answers in output integer register 0: 1 for ready, 2 for done, back
to 1 once the command register is cleared. What such a script would do is done here, in steps of
2 ms.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tpcd.robot.emulator.settings import EmulatorSettings, emulated_frame, emulated_scene
from tpcd.robot.emulator.surface import CompliantWorld
from tpcd.robot.frames import out_of_plane, planar_pose, tcp_pose, tcp_wrench

STEP = 0.002
"""Length of a cycle [s]."""
READY, DONE = 1, 2
NONE, MOVE_L, ZERO_SENSOR, SERVO_STOP, SET_PAYLOAD, SERVO_L = 0, 3, 8, 16, 17, 24
PROTECTIVE_STOP, WATCHDOG, KICK, STOP_SCRIPT = 31, 35, 99, 255
CONTINUOUS = (SERVO_L, KICK)
"""Commands that are never answered with done."""
POWER_ON, PROGRAM_RUNNING = 1, 2
NORMAL_MODE, PROTECTIVE_STOPPED = 1, 4
WRONG_MASS = 0.8
"""What the controller does not know it carries under the fault wrong_payload [kg]."""
DRIFT = 0.6
"""Of the force along the base's z under the fault drifting_sensor [N/s]."""
FROZEN = 0.25
"""Of each channel of the wrench under the fault frozen_sensor [N, N·m]."""
GRAVITY = 9.81
SLOWEST = 1e-3
"""Speed of a move whose client states none [m/s]."""
LEVER = 0.2
"""A turn counts as the way of a point so far away [m]."""


class Controller:
    """State of one emulated controller; time goes on only by `advance`. The arm lives in the plane
    of the task: a target outside of it ends in a protective stop."""

    def __init__(self, settings: EmulatorSettings) -> None:
        scene = emulated_scene(settings)
        self.settings, self._frame = settings, emulated_frame(settings)
        theta = scene.theta
        self._world = CompliantWorld(
            scene.vertices_ee.numpy(),
            theta["friction"],
            theta["floor_height"],
            theta["wall_position"],
            settings.compliance,
        )
        self._random = np.random.default_rng(settings.seed + 1)
        self._target = self._actual = scene.start_pose.numpy()
        self._delayed = deque([self._target] * round(settings.servo_delay / STEP))
        self._speed = np.zeros(3)
        self._moving: tuple[np.ndarray, float] | None = None
        self._input: dict[str, Any] = {}
        self._output: dict[str, Any] = {}
        self._executing = False
        self._watchdog: float | None = None
        self.time, self.servo_time, self.last_input = 0.0, 0.0, 0.0
        self.servoing = self.running = self.protective_stopped = False
        self.payload = settings.payload
        self._zero = np.zeros(6)
        self._load = self._sense()

    def upload(self) -> None:
        """A script was received whole: it runs and is ready."""
        if self.protective_stopped:
            return
        self.running, self._executing = True, False
        self._output["output_int_register_0"] = READY

    def stop_program(self) -> None:
        """The script ends; the arm stays where it is."""
        self.running = self.servoing = False
        self._moving, self._watchdog = None, None
        self._target = self._actual
        self._output["output_int_register_0"] = NONE

    def protective_stop(self) -> None:
        """As the safety system does: the arm stops, the program with it."""
        self.stop_program()
        self.protective_stopped = True

    def unlock(self) -> None:
        """Release a protective stop."""
        self.protective_stopped = False

    def write(self, values: dict[str, Any]) -> bool:
        """Take input registers; returns whether they were a servo target."""
        self._input.update(values)
        self.last_input = self.time
        command = self._input.get("input_int_register_0", NONE)
        if command == SERVO_L and self.running and not self._executing:
            self._target = self._planar_input()
            self.servoing = True
            return True
        return False

    def advance(self) -> None:
        """One cycle of 2 ms: script, arm, contact, sensors."""
        self.time += STEP
        if self.running:
            self._run_script()
        self._move()
        if self.servoing:
            self.servo_time += STEP
            if self.is_due("protective_stop"):
                self.protective_stop()

    def is_due(self, fault: str) -> bool:
        """Whether a fault that comes while the arm is moved has come."""
        settings = self.settings
        return settings.fault == fault and self.servo_time >= settings.fault_after

    def outputs(self) -> dict[str, Any]:
        """Values of all output fields."""
        settings, frame = self.settings, self._frame
        noise = settings.pose_noise * np.array([1, 1, 1, 2, 2, 2])
        tcp = tcp_pose(frame, self._actual)
        pose = tcp + noise * self._random.standard_normal(6)
        running = PROGRAM_RUNNING if self.running else 0
        speed = np.zeros(6)
        speed[:3] = self._speed[0] * frame.x_axis + self._speed[1] * frame.z_axis
        speed[3:] = self._speed[2] * frame.normal
        force = settings.force_noise * np.array([1, 1, 1, 0.05, 0.05, 0.05])
        wrench = self._load - _turned(tcp, self._zero)
        wrench = wrench + force * self._random.standard_normal(6)
        if settings.fault == "frozen_sensor":
            wrench = np.full(6, FROZEN)
        elif self.is_due("no_numbers"):
            wrench = np.full(6, np.nan)
        return {
            **self._output,
            "timestamp": self.time,
            "actual_TCP_pose": pose.tolist(),
            "actual_TCP_speed": speed.tolist(),
            "actual_TCP_force": wrench.tolist(),
            "target_TCP_pose": tcp_pose(frame, self._target).tolist(),
            "robot_mode": 7,
            "safety_mode": 3 if self.protective_stopped else 1,
            "safety_status": 3 if self.protective_stopped else 1,
            "runtime_state": 2 if self.running else 1,
            "speed_scaling": 1.0,
            "payload": self.payload,
            "robot_status_bits": POWER_ON | running,
            "safety_status_bits": PROTECTIVE_STOPPED if self.protective_stopped else NORMAL_MODE,
        }

    def _run_script(self) -> None:
        command = int(self._input.get("input_int_register_0", NONE))
        if self._watchdog is not None and self.time - self.last_input > 1 / self._watchdog:
            self.stop_program()
        elif self._executing:
            if command == NONE:
                self._executing = False
                self._output["output_int_register_0"] = READY
        elif command == STOP_SCRIPT:
            self.stop_program()
        elif command == PROTECTIVE_STOP:
            self.protective_stop()
        elif command != NONE and command not in CONTINUOUS and self._execute(command):
            self._executing = True
            self._output["output_int_register_0"] = DONE

    def _execute(self, command: int) -> bool:
        """Whether a command is done; what an emulator need not do is done at once."""
        first = float(self._input.get("input_double_register_0", 0.0))
        if command == MOVE_L:
            if self._moving is None:
                speed = float(self._input.get("input_double_register_6", 0.0)) or SLOWEST
                self._moving = self._planar_input(), speed
            elif np.allclose(self._actual, self._moving[0], atol=1e-9):
                self._moving = None
                return True
            return False
        if command == SERVO_STOP:
            self.servoing = False
            self._target = self._actual
        elif command == ZERO_SENSOR:
            # The sensor turns with the tool, and its zero with it.
            self._zero = _turned(tcp_pose(self._frame, self._actual), self._load, back=True)
        elif command == SET_PAYLOAD:
            self.payload = first
        elif command == WATCHDOG:
            self._watchdog = first if first > 0 else None
        return True

    def _move(self) -> None:
        if self._moving is not None:
            target, speed = self._moving
            way = target - self._target
            steps = max(np.hypot(way[0], way[1]), LEVER * abs(way[2])) / (speed * STEP)
            self._target = self._target + way / max(1.0, float(steps))
        self._delayed.append(self._target)
        before, self._actual = self._actual, self._delayed.popleft()
        self._speed = (self._actual - before) / STEP
        self._load = self._sense()

    def _sense(self) -> Float[np.ndarray, " 6"]:
        """Wrench at the TCP along base axes [N, N·m], before zeroing and without noise."""
        wrench = tcp_wrench(self._frame, self._world.wrench(self._actual))
        if self.settings.fault == "wrong_payload":
            wrench[2] -= WRONG_MASS * GRAVITY
        if self.settings.fault == "drifting_sensor":
            wrench[2] += DRIFT * self.time
        return wrench

    def _planar_input(self) -> Float[np.ndarray, " 3"]:
        """The target in the input registers, in the plane; from outside of it, a stop."""
        names = [f"input_double_register_{index}" for index in range(6)]
        tcp = np.array([self._input.get(name, 0.0) for name in names], dtype=float)
        in_plane = np.isfinite(tcp).all()
        if in_plane:
            distance, lean = out_of_plane(self._frame, tcp)
            in_plane = distance <= 0.005 and lean <= 0.05
        if not in_plane:
            self.protective_stop()
            return self._actual
        return planar_pose(self._frame, tcp)


def _turned(
    tcp: Float[np.ndarray, " 6"], wrench: Float[np.ndarray, " 6"], back: bool = False
) -> Float[np.ndarray, " 6"]:
    """A wrench along tool axes along those of the base, or back."""
    turn = Rotation.from_rotvec(tcp[3:])
    return turn.apply(wrench.reshape(2, 3), inverse=back).reshape(6)
