"""A Universal Robots arm that explores: admittance over its position servo, within limits.

`servo` has the loop that moves the arm, `guard` brings it to rest however a move ends, and
`zeroing` finds out whether it stands free.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.errors import RobotError
from tpcd.files import read_json, write_json
from tpcd.quality.finding import Finding
from tpcd.robot import preflight
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.frames import TaskFrame, out_of_plane, planar_pose, task_frame
from tpcd.robot.free_space import check_room, lifted
from tpcd.robot.guard import RETREATED, Guard
from tpcd.robot.link import Link
from tpcd.robot.protocol import Reading, stopped_first
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo, tensor_of
from tpcd.robot.zero_watch import ZeroWatch
from tpcd.robot.zeroing import Lifted, lift, turning_force, zeroed_at

FRAME_FILE = "frame.json"


class UniversalRobot:
    """A UR arm under admittance control that holds an object; implements `Robot`. As a context it
    stops the arm and lets go of it at the end."""

    def __init__(
        self, settings: ArmSettings, folder: Path, confirm: Callable[[str], bool] = lambda _: False
    ) -> None:
        """`folder` takes raw readings and the frame; `confirm` is shown what will happen, and the
        arm stays where it is unless it answers True."""
        self.settings, self._folder, self._confirm = settings, folder, confirm
        self._guard = Guard(folder)
        self._link: Link | None = None
        self._first: np.ndarray | None = None
        self._std, self._turning = torch.zeros(6, dtype=torch.float64), 0.0
        self._zero: ZeroWatch | None = None
        self._before, self._first_new = 0, 0
        """Moves before the present episode, and its first row that this session measures."""
        self._notes = settings.notes

    @property
    def at_rest(self) -> str | None:
        """How the arm was left after a stop; None while it may be moved."""
        return self._guard.at_rest

    def __enter__(self) -> UniversalRobot:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        try:
            left = self.stop()
        finally:
            self.close()
        if left is not None and kind is None:
            raise RobotError(left)

    def start(self) -> Episode:
        """Connect, ask, lift the arm, zero and check its sensor in free air and go back; the
        episode of the start pose.

        Where lifting shows that the arm touches something, it asks whether to start from the pose
        above instead. Raises RobotError with one line for each check that fails.
        """
        tcp, said = self._connect(), self.settings
        frame = task_frame(tcp, said.x_axis, said.z_axis, said.origin, said.tool_zero)
        servo = self._begin(frame)

        def survey() -> Lifted:
            write_json(self._folder / FRAME_FILE, vars(frame))
            start = planar_pose(frame, tcp)
            servo.check_inside("the start pose", start)
            check_room(said, start)
            return lift(servo)

        with stopped_first(self.stop):
            found = self._guard.move("preflight", survey)
            start = found.start
            if found.touch.felt:
                start = self._instead(servo, found)
            return self._guard.move("zeroing", lambda: self._first_row(servo, start))

    def restart(self) -> Episode:
        """Leave what is touched, zero the sensor in the air above the start pose and go there; a
        new episode of the same set-up, whose rows are counted on in `raw`. Raises RobotError."""
        if self._first is None:
            raise RobotError("the arm has not started, so there is no start to go back to")
        servo, first = self._require_servo(), self._first

        def back() -> Episode:
            servo.retreat()
            assert servo.state is not None, "it has just moved"
            self._go_above(servo, first, float(servo.state.reference[1]))
            return self._zero_at(servo, first)

        return self._guard.move(f"back_{self._guard.row:03d}", back)

    def settle(self, command: Float[Tensor, " 3"]) -> Reading:
        """Give way to the command until pose and force are steady, and average them.

        Raises RobotError for a command outside of the workspace, and where the arm had to stop.
        """
        target = command.detach().double().numpy()
        if target.shape != (3,):
            raise ValueError(f"command has shape {target.shape}, expected 3 numbers")
        servo = self._require_servo()
        servo.check_inside("a command", target)
        self._guard.row += 1

        def measured() -> Reading:
            reading = replace(servo.settle(target), sensor_std=self._std)
            if self._zero is not None:
                self._zero.moved(self._guard.row - self._before, reading)
            return reading

        name = f"row_{self._guard.row:03d}"
        return self._guard.move(name, measured, command=target.tolist())

    def resume(self, episode: Episode) -> None:
        """Start, go to the earlier start pose and repeat the moves, since friction keeps the path.

        Raises RobotError where a pose is not as it was: the object has slipped or the place moved.
        """
        path = self._folder / FRAME_FILE
        if not path.is_file():
            raise RobotError(
                f"{path} is missing, so nobody knows the world of these rows; start anew"
            )
        tcp = self._connect()
        frame = TaskFrame(**{key: np.array(v) for key, v in read_json(path).items()})
        distance, lean = out_of_plane(frame, tcp)
        if distance > 0.005 or lean > 0.03:
            raise RobotError(
                f"the tool is {1e3 * distance:.0f} mm and {lean:.2f} rad out of the plane of the"
                " earlier rows; bring it back there in free air"
            )
        servo, first = self._begin(frame), episode.poses[0].numpy()
        self._first_new = len(episode)

        def back() -> None:
            here = lift(servo).start
            self._go_above(servo, first, here[1])
            self._first_row(servo, first)

        with stopped_first(self.stop):
            self._guard.move("preflight_resumed", back)
            length, angle = self.settings.resume_tolerance
            for row in range(1, len(episode)):
                reading = self.settle(episode.commands[row])
                off = (reading.pose - episode.poses[row]).abs()
                if float(off[:2].max()) > length or float(off[2]) > angle:
                    raise self._guard.refusal(
                        f"repeating move {row} ends {1e3 * float(off[:2].max()):.1f} mm and"
                        f" {1e3 * float(off[2]):.0f} mrad from where it did, expected at most"
                        f" {1e3 * length:g} mm and {1e3 * angle:g} mrad; the object has slipped,"
                        " the place has moved, or the sensor's zero was another: start a new"
                        " exploration",
                        resumable=False,
                    )

    def stop(self) -> str | None:
        """Hold at once, and retreat where that is safe; nothing if it has been done. Returns how
        the arm was left where it did not retreat, or where its readings were not kept.

        Ctrl-C ends the retreat, and is raised once the arm is at rest.
        """
        if self._link is None:
            return None
        self._guard.stop()
        return None if self.at_rest == RETREATED or not self._has_moved else self.at_rest

    @property
    def _has_moved(self) -> bool:
        return self._guard.servo is not None and self._guard.servo.state is not None

    def doubts(self) -> tuple[Finding, ...]:
        """Whether the sensor's zero has drifted since the present episode began, as far as it was
        read in free air, at the latest by `stop`."""
        return () if self._zero is None else self._zero.doubts(self._guard.in_air)

    def close(self) -> None:
        """Stop, end servo and script, and disconnect."""
        try:
            self.stop()
        finally:
            link, self._link, self._guard.servo = self._link, None, None
            atexit.unregister(self.close)
            if link is not None:
                with suppress(RobotError):  # It is at rest, and the script ends with the link.
                    link.stop()
                link.disconnect()

    def _connect(self) -> Float[np.ndarray, " 6"]:
        """The TCP pose of an arm that may be moved."""
        settings = self.settings
        if self._link is None:
            self._link = Link(settings.address, settings.rate, settings.stale_time)
            atexit.register(self.close)
        sample = self._link.next_sample()
        preflight.check_payload(settings.payload, self._link.payload())
        if not self._confirm(settings.sentence()):
            raise RobotError(
                "workspace and limits were not confirmed, so the arm was not moved; answer yes, or"
                " pass --yes where nobody can"
            )
        return sample.tcp

    def _begin(self, frame: TaskFrame) -> Servo:
        assert self._link is not None
        guard = self._guard
        guard.servo = Servo(self.settings, self._link, frame, RawRecord(), guard.signals)
        return guard.servo

    def _instead(self, servo: Servo, found: Lifted) -> Float[np.ndarray, " 3"]:
        """The free pose from which the arm may start instead of one that touches."""
        assert servo.state is not None
        above = servo.state.reference
        x, z, angle = above.tolist()
        touches = (
            f"the object touches where it starts, and would be zeroed in contact: {found.touch}"
        )
        asked = (
            f"{touches}. The sensor is zeroed in the air, and the arm starts from the free pose"
            f" above it, ({x:.3f}, {z:.3f}, {angle:.3f}) [m, m, rad]."
        )
        if not self._confirm(asked[0].upper() + asked[1:]):
            raise self._guard.refusal(f"{touches}; bring it into free air and start anew")
        told = f"start pose moved to free air, since {touches}"
        self._notes = told if self._notes is None else f"{self._notes}; {told}"
        return above

    def _go_above(self, servo: Servo, start: Float[np.ndarray, " 3"], height: float) -> None:
        """From the air over to above a start pose, no lower than `height` on the way [m]."""
        above = lifted(self.settings, start)
        servo.ramp_to(np.array([above[0], max(above[1], height), above[2]]))

    def _first_row(self, servo: Servo, start: Float[np.ndarray, " 3"]) -> Episode:
        """From the air: check the payload, and the episode of the start pose."""
        servo.ramp_to(lifted(self.settings, start))
        turning = turning_force(servo)
        return self._zero_at(servo, start, turning)

    def _zero_at(
        self, servo: Servo, start: Float[np.ndarray, " 3"], turning: float | None = None
    ) -> Episode:
        """The episode of the start pose, at which the arm stands free; with the force that
        `turning` the tool leaves, the noise of its rows is measured."""
        settings = self.settings
        air, there = zeroed_at(servo, start)
        if turning is not None:
            self._turning, stiffness = turning, np.array(settings.stiffness)
            self._std = tensor_of(preflight.row_noise(air, turning, servo.settling, stiffness))
        std = self._std.numpy()
        self._zero = ZeroWatch(air, there, std, servo.noise, self._turning, self._first_new)
        self._before = self._guard.row
        first = self._first = there.poses.mean(0)
        pose, wrench = tensor_of(first), tensor_of(there.wrenches.mean(0))
        return Episode(
            commands=pose[None].clone(),
            poses=pose[None],
            wrenches=wrench[None],
            stiffness=tensor_of(np.array(settings.stiffness)),
            sensor_std=self._std,
            object=settings.object,
            notes=self._notes,
            priors=dict(settings.priors),
        )

    def _require_servo(self) -> Servo:
        if self._guard.servo is None:
            raise RobotError("the arm is not connected; start it first")
        return self._guard.servo
