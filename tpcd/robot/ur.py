"""A Universal Robots arm that explores: admittance over its position servo, within limits.

Every reading is checked (fresh stamp, safety system, force, workspace, whether the arm follows) and
recorded. Whatever ends a move, the arm holds; where its link and safety system allow, it then
retreats: up, and to the left where it is pushed there. All readings of a move are on disk before
the error reaches the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.errors import RobotError
from tpcd.results import read_json, write_json
from tpcd.robot import preflight
from tpcd.robot.admittance import AdmittanceState, advance, at_rest, residual
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.frames import TaskFrame, out_of_plane, planar_pose, planar_wrench, task_frame
from tpcd.robot.frames import tcp_pose as tcp_of
from tpcd.robot.link import Link, Sample
from tpcd.robot.protocol import Reading
from tpcd.robot.raw import RawRecord
from tpcd.robot.settling import SettlingSettings, Window

FRAME_FILE = "frame.json"
MARGIN = (0.005, 0.005, 0.02)
"""How far a pose may be outside of the workspace before the arm stops [m, m, rad]."""
FOLLOWING = (0.015, 0.015, 0.1)
"""How far the arm may be from its target: the delay's way at full speed, several times over."""
RAMP_SPEED = 0.03
"""Of moves in free air [m/s]; of their angle, ten times that [rad/s]."""
RAMP_FORCE, RETREAT_FORCE = 4.0, 10.0
"""Further force that ends a move in free air, and a retreat, at whose start friction turns [N]."""
LARGEST_STEP = 0.05
"""Of the admittance after a pause of this process [s]."""


class UniversalRobot:
    """A UR arm under admittance control that holds an object; implements `Robot`."""

    def __init__(
        self, settings: ArmSettings, folder: Path, confirm: Callable[[str], bool] = lambda _: False
    ) -> None:
        """`folder` takes raw readings and the frame; `confirm` is shown what will happen, and the
        arm stays where it is unless it answers True."""
        self.settings, self._folder, self._confirm = settings, folder, confirm
        self._law, self._settling = settings.admittance, SettlingSettings()
        self._raw = RawRecord()
        self._link: Link | None = None
        self._frame: TaskFrame | None = None
        self._state: AdmittanceState | None = None
        self._first: np.ndarray | None = None
        self._noise, self._std = np.zeros(3), torch.zeros(6, dtype=torch.float64)
        self._over, self._row = 0, 0
        self.at_rest: str | None = None
        """How the arm was left after a stop; None while it may be moved."""

    def start(self) -> Episode:
        """Connect, ask, check payload and sensor in free air; the episode of the start pose.

        Raises RobotError with one line for each check that fails.
        """
        tcp = self._connect()
        said = self.settings
        self._frame = task_frame(tcp, said.x_axis, said.z_axis, said.origin, said.tool_zero)
        with self._watched("preflight"):
            self._check_inside("the start pose", planar_pose(self._frame, tcp))
            self._std = self._check_free_air()
            first = self._first_row()
        self._write_frame()
        return first

    def restart(self) -> Episode:
        """Leave what is touched, go back to the start pose and zero the sensor there; a new episode
        of the same set-up, whose rows are counted on in `raw`. Raises RobotError."""
        if self._first is None:
            raise RobotError("the arm has not started, so there is no start to go back to")
        with self._watched(f"back_{self._row:03d}"):
            self._retreat()
            assert self._state is not None
            height = max(float(self._state.reference[1]), float(self._first[1]))
            self._ramp_to(np.array([self._first[0], height, self._first[2]]))
            self._ramp_to(self._first)
            self._require_link().zero_sensor()
            return self._first_row()

    def settle(self, command: Float[Tensor, " 3"]) -> Reading:
        """Give way to the command until pose and force are steady, and average them.

        Raises RobotError for a command outside of the workspace, and where the arm had to stop.
        """
        target = command.detach().double().numpy()
        self._check_inside("a command", target)
        self._row += 1
        with self._watched(f"row_{self._row:03d}", command=target.tolist()):
            return self._settle(target)

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
        self._frame = TaskFrame(**{key: np.array(v) for key, v in read_json(path).items()})
        distance, lean = out_of_plane(self._frame, tcp)
        if distance > 0.005 or lean > 0.03:
            raise RobotError(
                f"the tool is {1e3 * distance:.0f} mm and {lean:.2f} rad out of the plane of the"
                " earlier rows; bring it back there in free air"
            )
        with self._watched("preflight_resumed"):
            self._check_free_air()
            first = episode.poses[0].numpy()
            over = np.array([first[0], max(first[1], planar_pose(self._frame, tcp)[1]), first[2]])
            self._ramp_to(over)
            self._ramp_to(first)
            self._require_link().zero_sensor()
            self._stand(self._settling.window)
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
                    " place has moved, so start a new exploration"
                )

    def stop(self) -> None:
        """Hold at once, and retreat where that is safe; nothing if it has been done."""
        if self._link is None or self.at_rest is not None:
            return
        self.at_rest = "the arm holds its place"
        if self._frame is None or self._state is None or not self._link.alive:
            return
        try:
            self._retreat()
            self.at_rest = "the arm has retreated"
        except RobotError as error:
            self.at_rest = f"the arm holds its place, its way back not being free ({error})"
        finally:
            self._raw.write(self._folder, "retreat", {"row": self._row, "ended": self.at_rest})

    def close(self) -> None:
        """End servo and script, and disconnect."""
        if self._link is None:
            return
        link, self._link = self._link, None
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

    def _check_free_air(self) -> Float[Tensor, " 6"]:
        """Check payload and sensor, measure the noise; standard deviations of a row."""
        link, settings = self._require_link(), self.settings
        first = self._stand(0.3)
        preflight.check_before_zeroing(first)
        start = first.poses.mean(0)
        self._state = at_rest(start, np.zeros(3))
        link.zero_sensor()
        air = self._stand(settings.still_time)
        preflight.check_zeroed(air)
        self._noise = preflight.reading_noise(air)
        above = start + np.array([0.0, settings.retreat, 0.0])
        above[1] = min(above[1], settings.workspace_high[1])
        self._ramp_to(above)
        tilted = []
        for limit, angle in zip(
            (settings.workspace_low, settings.workspace_high), (-1, 1), strict=True
        ):
            tilt = angle * min(abs(limit[2]), preflight.TILT)
            self._ramp_to(np.array([above[0], above[1], tilt]))
            tilted.append(self._stand(0.6))
        turning = preflight.check_tilted(*tilted)
        self._ramp_to(above)
        self._ramp_to(start)
        link.zero_sensor()
        fast, slow = preflight.mean_noise(air, self._settling.window)
        # A row is taken once the mean wrench is K (r - u) to within what counts as still, so the
        # fast noise of the force is no longer in the force: the spring has turned it into motion,
        # in free air in full and in contact, damped more, hardly; half of it is taken.
        still = 0.5 * np.array(self._settling.residual)
        moved = np.sqrt(still**2 + (0.5 * fast[3:]) ** 2 + slow[3:] ** 2)
        moved = moved / np.array(settings.stiffness)
        pose_std = np.sqrt(fast[:3] ** 2 + slow[:3] ** 2 + moved**2)
        wrench_std = np.hypot(still, slow[3:])
        wrench_std[:2] = np.hypot(wrench_std[:2], 0.5 * turning)
        return _tensor(np.concatenate((pose_std, wrench_std)))

    def _first_row(self) -> Episode:
        """The episode of the pose at which the arm stands free."""
        air, settings = self._stand(self._settling.window), self.settings
        first = self._first = air.poses.mean(0)
        pose, wrench = _tensor(first), _tensor(air.wrenches.mean(0))
        return Episode(
            commands=pose[None].clone(),
            poses=pose[None],
            wrenches=wrench[None],
            stiffness=_tensor(np.array(settings.stiffness)),
            sensor_std=self._std,
            object=settings.object,
            notes=settings.notes,
            priors=dict(settings.priors),
        )

    def _settle(self, command: Float[np.ndarray, " 3"]) -> Reading:
        link, frame = self._require_link(), self._frame
        assert frame is not None and self._state is not None, "start first"
        window, last, began = Window(self._settling, self._noise), None, None
        count, still = 0, None
        while still is None:
            sample, pose, wrench = self._read()
            began = sample.stamp if began is None else began
            passed = 1 / link.rate if last is None else sample.stamp - last
            last = sample.stamp
            state = advance(self._law, self._state, command, wrench, min(passed, LARGEST_STEP))
            self._state = state
            link.servo(tcp_of(frame, state.reference))
            window.add(sample.stamp, pose, wrench, residual(self._law, state, command))
            count += 1
            if count % 12:
                continue
            if window.unstable():
                raise RobotError(
                    "the force oscillates: the surface is stiffer than stated, or the arm slower;"
                    f" state less than {self.settings.surface_mm_per_10n:g} mm per 10 N"
                )
            still = window.still()
            if still is None and sample.stamp - began > self.settings.settle_time:
                break
        settled = still is not None
        still = still or window.mean()
        return Reading(
            _tensor(still.pose), _tensor(still.wrench), settled, stamps=(still.start, still.end)
        )

    def _read(self) -> tuple[Sample, Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """The next reading, checked and recorded."""
        frame, state = self._frame, self._state
        assert frame is not None
        sample = self._require_link().next_sample()
        pose, wrench = planar_pose(frame, sample.tcp), planar_wrench(frame, sample.wrench)
        reference = pose if state is None else state.reference
        self._raw.add(sample, pose, wrench, reference)
        limit = self.settings.stop_force * np.array([1.0, 1.0, 0.2])
        self._over = self._over + 1 if bool((np.abs(wrench) > limit).any()) else 0
        if self._over > 1:
            raise RobotError(
                f"a wrench of ({wrench[0]:.1f}, {wrench[1]:.1f} N, {wrench[2]:.2f} N·m), beyond the"
                f" limit of {self.settings.stop_force:g} N"
            )
        off = np.abs(pose - reference)
        if bool((off > FOLLOWING).any()):
            raise RobotError(
                f"the arm is {1e3 * off[:2].max():.0f} mm and {1e3 * off[2]:.0f} mrad from its"
                " target; it does not follow: look at speed slider, joint limits and collisions"
            )
        self._check_inside("the arm", pose, MARGIN)
        return sample, pose, wrench

    def _check_inside(
        self, what: str, pose: Float[np.ndarray, " 3"], margin: tuple[float, ...] = (1e-9,) * 3
    ) -> None:
        low, high = (
            np.array(v) for v in (self.settings.workspace_low, self.settings.workspace_high)
        )
        if bool((pose < low - margin).any() or (pose > high + margin).any()):
            shown = ", ".join(f"{value:.3f}" for value in pose)
            raise RobotError(
                f"{what} is at ({shown}) [m, m, rad], outside of the workspace from"
                f" {self.settings.workspace_low} to {self.settings.workspace_high}"
            )

    def _stand(self, seconds: float) -> preflight.FreeAir:
        """Readings of an arm that is not moved."""
        rows: list[np.ndarray] = []
        frame, state = self._frame, self._state
        while not rows or rows[-1][0] - rows[0][0] < seconds:
            sample, pose, wrench = self._read()
            if state is not None and frame is not None:
                self._require_link().servo(tcp_of(frame, state.reference))
            rows.append(np.concatenate(([sample.stamp], pose, wrench)))
        table = np.array(rows)
        return preflight.FreeAir(table[:, 0], table[:, 1:4], table[:, 4:7])

    def _ramp_to(self, goal: Float[np.ndarray, " 3"], allowed: float = RAMP_FORCE) -> None:
        """Straight to a pose; RobotError where a force grows by more than `allowed` [N]."""
        link, frame = self._require_link(), self._frame
        assert frame is not None
        before: np.ndarray | None = None
        waited = 0
        while waited < 0.3 * link.rate:
            _, pose, wrench = self._read()
            state = self._state or at_rest(pose, np.zeros(3))
            before = wrench if before is None else before
            if float((np.abs(wrench) - np.abs(before))[:2].max()) > allowed:
                raise RobotError(
                    f"the arm met a force of {np.abs(wrench[:2]).max():.1f} N on its way through"
                    " what should be free air"
                )
            way = goal - state.reference
            steps = max(np.hypot(way[0], way[1]), abs(way[2]) / 10) / RAMP_SPEED * link.rate
            waited += steps < 1
            reference = state.reference + way / max(1.0, float(steps))
            self._state = AdmittanceState(reference, np.zeros(3), wrench)
            link.servo(tcp_of(frame, reference))

    def _retreat(self) -> None:
        """Away from what may be touched, then up; the arm holds where the way is not free.

        The world has a floor below and a wall on the right, and both may be felt only through
        friction. So the way is up, and at first also to the left where the arm is pushed there.
        """
        assert self._state is not None
        settings, here = self.settings, self._state.reference
        self._over = -(10**6)  # The limit may be exceeded still: the ramp looks to the force.
        left = -1.0 if float(self._state.wrench[0]) < -1.0 else 0.0
        low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
        try:
            for way in (np.array([left, 1.0, 0.0]), np.array([0.0, 1.0, 0.0])):
                goal = here + 0.5 * settings.retreat * way
                goal = np.clip(goal, np.minimum(low, here), np.maximum(high, here))
                self._ramp_to(goal, RETREAT_FORCE)
                here = self._state.reference
        finally:
            self._over = 0

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
                raise RobotError(f"{error}; {self.at_rest}") from error
            raise
        self._raw.write(self._folder, name, {**about, "ended": "done"})

    def _write_frame(self) -> None:
        frame = self._frame
        assert frame is not None
        write_json(self._folder / FRAME_FILE, vars(frame))

    def _require_link(self) -> Link:
        if self._link is None:
            raise RobotError("the arm is not connected; start it first")
        return self._link


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float64).copy())
