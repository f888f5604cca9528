"""A Universal Robots arm that explores: admittance over its position servo, within limits.

`servo` has the loop that moves the arm. Whatever ends a move, the arm holds; where its link and
safety system allow, it then retreats: up, and to the left where it is pushed there. All readings of
a move are on disk before the error reaches the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.errors import RobotError
from tpcd.files import read_json, write_json
from tpcd.robot import preflight
from tpcd.robot.admittance import at_rest
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.frames import TaskFrame, out_of_plane, planar_pose, task_frame
from tpcd.robot.link import Link
from tpcd.robot.protocol import Reading
from tpcd.robot.raw import RawRecord
from tpcd.robot.servo import Servo, tensor_of

FRAME_FILE = "frame.json"


class UniversalRobot:
    """A UR arm under admittance control that holds an object; implements `Robot`."""

    def __init__(
        self, settings: ArmSettings, folder: Path, confirm: Callable[[str], bool] = lambda _: False
    ) -> None:
        """`folder` takes raw readings and the frame; `confirm` is shown what will happen, and the
        arm stays where it is unless it answers True."""
        self.settings, self._folder, self._confirm = settings, folder, confirm
        self._raw = RawRecord()
        self._link: Link | None = None
        self._servo: Servo | None = None
        self._first: np.ndarray | None = None
        self._std = torch.zeros(6, dtype=torch.float64)
        self._row = 0
        self.at_rest: str | None = None
        """How the arm was left after a stop; None while it may be moved."""

    def start(self) -> Episode:
        """Connect, ask, check payload and sensor in free air; the episode of the start pose.

        Raises RobotError with one line for each check that fails.
        """
        tcp = self._connect()
        said = self.settings
        frame = task_frame(tcp, said.x_axis, said.z_axis, said.origin, said.tool_zero)
        servo = self._begin(frame)
        write_json(self._folder / FRAME_FILE, vars(frame))
        with self._watched("preflight"):
            servo.check_inside("the start pose", planar_pose(frame, tcp))
            self._std = self._check_free_air(servo)
            return self._first_row(servo)

    def restart(self) -> Episode:
        """Leave what is touched, go back to the start pose and zero the sensor there; a new episode
        of the same set-up, whose rows are counted on in `raw`. Raises RobotError."""
        if self._first is None:
            raise RobotError("the arm has not started, so there is no start to go back to")
        servo, first = self._require_servo(), self._first
        with self._watched(f"back_{self._row:03d}"):
            height = max(float(servo.retreat()[1]), float(first[1]))
            servo.ramp_to(np.array([first[0], height, first[2]]))
            servo.ramp_to(first)
            servo.link.zero_sensor()
            return self._first_row(servo)

    def settle(self, command: Float[Tensor, " 3"]) -> Reading:
        """Give way to the command until pose and force are steady, and average them.

        Raises RobotError for a command outside of the workspace, and where the arm had to stop.
        """
        target = command.detach().double().numpy()
        servo = self._require_servo()
        servo.check_inside("a command", target)
        self._row += 1
        with self._watched(f"row_{self._row:03d}", command=target.tolist()):
            return replace(servo.settle(target), sensor_std=self._std)

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
        servo = self._begin(frame)
        with self._watched("preflight_resumed"):
            self._std = self._check_free_air(servo)
            first = episode.poses[0].numpy()
            over = np.array([first[0], max(first[1], planar_pose(frame, tcp)[1]), first[2]])
            servo.ramp_to(over)
            servo.ramp_to(first)
            servo.link.zero_sensor()
            servo.stand(servo.settling.window)
        length, angle = self.settings.resume_tolerance
        for row in range(1, len(episode)):
            reading = self.settle(episode.commands[row])
            off = (reading.pose - episode.poses[row]).abs()
            if float(off[:2].max()) > length or float(off[2]) > angle:
                self.stop()
                raise RobotError(
                    f"repeating move {row} ends {1e3 * float(off[:2].max()):.1f} mm and"
                    f" {1e3 * float(off[2]):.0f} mrad from where it did, expected at most"
                    f" {1e3 * length:g} mm and {1e3 * angle:g} mrad; the object has slipped or the"
                    " place has moved, so start a new exploration",
                    resumable=False,
                )

    def stop(self) -> None:
        """Hold at once, and retreat where that is safe; nothing if it has been done."""
        if self._link is None or self.at_rest is not None:
            return
        self.at_rest = "the arm holds its place"
        if self._servo is None or self._servo.state is None or not self._link.alive:
            return
        try:
            self._servo.retreat()
            self.at_rest = "the arm has retreated"
        except RobotError as error:
            self.at_rest = f"the arm holds its place, its way back not being free ({error})"
        finally:
            self._raw.write(self._folder, "retreat", {"row": self._row, "ended": self.at_rest})

    def close(self) -> None:
        """End servo and script, and disconnect."""
        if self._link is None:
            return
        link, self._link, self._servo = self._link, None, None
        try:
            link.stop()
        finally:
            link.disconnect()

    def _connect(self) -> Float[np.ndarray, " 6"]:
        """The TCP pose of an arm that may be moved."""
        settings = self.settings
        if self._link is None:
            self._link = Link(settings.address, settings.rate, settings.stale_time)
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
        self._servo = Servo(self.settings, self._link, frame, self._raw)
        return self._servo

    def _check_free_air(self, servo: Servo) -> Float[Tensor, " 6"]:
        """Check payload and sensor, measure the noise; standard deviations of a row."""
        settings = self.settings
        first = servo.stand(0.3)
        preflight.check_before_zeroing(first)
        start = first.poses.mean(0)
        servo.state = at_rest(start, np.zeros(3))
        servo.link.zero_sensor()
        air = servo.stand(settings.still_time)
        preflight.check_zeroed(air)
        servo.noise = preflight.reading_noise(air)
        above = start + np.array([0.0, settings.retreat, 0.0])
        above[1] = min(above[1], settings.workspace_high[1])
        servo.ramp_to(above)
        tilted = []
        for limit, angle in zip(
            (settings.workspace_low, settings.workspace_high), (-1, 1), strict=True
        ):
            tilt = angle * min(abs(limit[2]), preflight.TILT)
            servo.ramp_to(np.array([above[0], above[1], tilt]))
            tilted.append(servo.stand(0.6))
        turning = preflight.check_tilted(*tilted)
        servo.ramp_to(above)
        servo.ramp_to(start)
        servo.link.zero_sensor()
        return tensor_of(
            preflight.row_noise(air, turning, servo.settling, np.array(settings.stiffness))
        )

    def _first_row(self, servo: Servo) -> Episode:
        """The episode of the pose at which the arm stands free."""
        air, settings = servo.stand(servo.settling.window), self.settings
        first = self._first = air.poses.mean(0)
        pose, wrench = tensor_of(first), tensor_of(air.wrenches.mean(0))
        return Episode(
            commands=pose[None].clone(),
            poses=pose[None],
            wrenches=wrench[None],
            stiffness=tensor_of(np.array(settings.stiffness)),
            sensor_std=self._std,
            object=settings.object,
            notes=settings.notes,
            priors=dict(settings.priors),
        )

    @contextmanager
    def _watched(self, name: str, **about: object) -> Iterator[None]:
        """Record a move however it ends, and bring the arm to rest if it ends badly; a stopped arm
        is not moved again."""
        if self.at_rest is not None:
            raise RobotError(f"{self.at_rest} since it was stopped; connect anew to move it")
        about = {"row": self._row, **about}
        try:
            yield
        except BaseException as error:
            ended = str(error) or type(error).__name__
            self._raw.write(self._folder, name, {**about, "ended": ended})
            self.stop()
            if isinstance(error, RobotError):
                raise RobotError(f"{error}; {self.at_rest}", error.resumable) from error
            raise
        self._raw.write(self._folder, name, {**about, "ended": "done"})

    def _require_servo(self) -> Servo:
        if self._servo is None:
            raise RobotError("the arm is not connected; start it first")
        return self._servo
