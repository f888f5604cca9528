"""The servo loop of an arm: hold, go straight, give way to a command, retreat.

Every reading is checked (fresh stamp, safety system, force, workspace, whether the arm follows) and
recorded, whatever the arm is doing.
"""

from __future__ import annotations

import threading
from collections import deque
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.errors import RobotError
from tpcd.robot.admittance import (
    AdmittanceState,
    advance,
    at_rest,
    for_new_command,
    residual,
    travel_time,
    turning_slower,
)
from tpcd.robot.arm_settings import ArmSettings
from tpcd.robot.command_way import command_way, moved_on
from tpcd.robot.frames import TaskFrame, planar_pose, planar_wrench
from tpcd.robot.frames import tcp_pose as tcp_of
from tpcd.robot.free_space import is_lifted, lifted
from tpcd.robot.held_signals import HeldSignals
from tpcd.robot.link import Link, Sample
from tpcd.robot.preflight import FreeAir
from tpcd.robot.protocol import Reading
from tpcd.robot.raw import RawRecord
from tpcd.robot.settling import SettlingSettings, Window

MARGIN = (0.005, 0.005, 0.02)
"""How far a pose may be outside of the workspace before the arm stops [m, m, rad]."""
FOLLOWING = (0.015, 0.015, 0.1)
"""How far the arm may be from its target: the delay's way at full speed, several times over."""
ARRIVED = (0.001, 0.001, 0.005)
"""The same where it has come to rest; one that does not follow, or whose reading has stopped, is
further off after most moves [m, m, rad]."""
RAMP_SPEED = 0.03
"""Of moves in free air [m/s]; of their angle, ten times that [rad/s]."""
ARRIVING = 0.3
"""Until the arm stands where its last target was, at the end of such a move [s]."""
RAMP_FORCE, RETREAT_FORCE = 4.0, 10.0
"""Further force that ends a move in free air, and a retreat, at whose start friction turns [N]."""
RECENT = 0.5
"""An arm that swings may begin its retreat between two blows: so far back it looks for them [s]."""
SLOWER_TURNS = 3
"""How often the damping of the angle is doubled before an oscillation ends the run."""
GENTLE = 2.5
"""An oscillation of more than so many times what counts as one ends the run at once."""
PROGRESS = 0.01
"""Share of the command's way whose time is limited, while the arm follows."""
FROZEN = 0.1
"""A channel of the wrench that repeats exactly for so long [s], and for longer than is its habit in
free air, is of a sensor that has stopped, unless its readings are said to have no noise."""
IN_AIR = 0.2
"""At the end of a retreat, over which the wrench in free air is read: `ARRIVING` less what a servo
lags behind, three times over [s]."""
WRENCH = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")
LARGEST_STEP = 0.05
"""Of the admittance after a pause of this process [s]."""


class Servo:
    """The loop from reading to target of one connected arm, in its task frame."""

    def __init__(
        self,
        settings: ArmSettings,
        link: Link,
        frame: TaskFrame,
        record: RawRecord,
        signals: HeldSignals | None = None,
    ) -> None:
        """An arm that is only read, until `state` is set. Signals that `signals` holds are looked
        at with each reading."""
        self.settings, self.link, self.frame = settings, link, frame
        self.record = record
        """Of the present move."""
        self._signals = signals or HeldSignals()
        self.halted = False
        """Whether nothing may move the arm any more but its retreat."""
        self._law, self.settling = settings.admittance, SettlingSettings()
        self.state: AdmittanceState | None = None
        """Where the arm is sent; None while it is only read."""
        self.noise = np.zeros(3)
        """Standard deviation of single readings of the wrench [N, N, N·m]."""
        self.longest_repeat = 0.0
        """Readings of a working sensor that may repeat one number."""
        self._over, self._slower, self._repeated = 0, 0, np.zeros(6, dtype=int)
        self._last_wrench = np.full(6, np.nan)
        self._retreating: int | None = None
        """Thread that makes the arm retreat."""
        self._recent: deque[np.ndarray] = deque(maxlen=max(1, round(RECENT * link.rate)))
        """Stamps, poses (3) and wrenches (3) of the last readings."""
        self._command: np.ndarray | None = None
        """The last one given way to; None where the arm went elsewhere since."""

    def read(self) -> tuple[Sample, Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """The next reading, checked and recorded."""
        self._signals.look()
        frame, state = self.frame, self.state
        sample = self.link.next_sample()
        self._check_alive(sample)
        known = bool(np.isfinite(sample.tcp).all())
        pose = planar_pose(frame, sample.tcp) if known else np.full(3, np.nan)
        wrench = planar_wrench(frame, sample.wrench)
        reference = pose if state is None else state.reference
        # What cannot be kept ends a move, and no retreat.
        with suppress(Exception) if self._retreating else nullcontext():
            self.record.add(sample, pose, wrench, reference)
        self._recent.append(np.concatenate(([sample.stamp], pose, wrench)))
        limit = self.settings.stop_force * np.array([1.0, 1.0, 0.2])
        over = bool((np.abs(wrench) > limit).any()) and not self._retreating
        self._over = self._over + 1 if over else 0
        if self._over > 1:
            raise RobotError(
                f"a wrench of ({wrench[0]:.1f}, {wrench[1]:.1f} N, {wrench[2]:.2f} N·m), beyond the"
                f" limit of {self.settings.stop_force:g} N"
            )
        self._check_near(pose, FOLLOWING)
        if known:
            self.check_inside("the arm", pose, MARGIN)
        return sample, pose, wrench

    def _check_alive(self, sample: Sample) -> None:
        """Raises RobotError for readings that are no numbers, and for a wrench that has frozen. A
        retreat goes by its targets: where the arm is sent is free, whatever is read there."""
        same = sample.wrench == self._last_wrench
        self._repeated = np.where(same, self._repeated + 1, 0)
        self._last_wrench = np.array(sample.wrench)
        if self._retreating:
            return
        if not (np.isfinite(sample.tcp).all() and np.isfinite(sample.wrench).all()):
            raise RobotError(
                f"a reading that is no number: pose {sample.tcp.tolist()}, wrench"
                f" {sample.wrench.tolist()}"
            )
        if self._frozen.any():
            still = [name for name, stopped in zip(WRENCH, self._frozen, strict=True) if stopped]
            raise RobotError(
                f"the force sensor has stopped: {', '.join(still)} of the base repeat"
                f" {self._last_wrench[self._frozen].tolist()} exactly; look at its cable and power,"
                " or say that it is noise_free, as an emulator may be, or one whose steps hide it"
            )

    @property
    def _frozen(self) -> Bool[np.ndarray, " 6"]:
        frozen = self._repeated > max(FROZEN * self.link.rate, self.longest_repeat)
        return np.zeros(6, dtype=bool) if self.settings.noise_free else frozen

    def _check_near(
        self, pose: Float[np.ndarray, " 3"], allowed: tuple[float, float, float]
    ) -> None:
        """Raises RobotError for a pose that is too far from where the arm was sent. What is no
        number is near, since a retreat goes by its targets."""
        if self.state is None:
            return
        off = pose - self.state.reference
        far = np.abs(off) > allowed
        if far.any():
            shown = [
                f"{name} is {size:.0f} {unit} from its target"
                for name, unit, size, told in zip(
                    ("x", "z", "phi"), ("mm", "mm", "mrad"), 1e3 * off, far, strict=True
                )
                if told
            ]
            raise RobotError(
                f"{' and '.join(shown)}: the arm does not follow, or this reading of its pose has"
                " stopped; look at speed slider, joint limits and collisions"
            )

    def stand(self, seconds: float) -> FreeAir:
        """Readings of an arm that is not moved."""
        rows: list[np.ndarray] = []
        state = self.state
        while not rows or rows[-1][0] - rows[0][0] < seconds:
            sample, pose, wrench = self.read()
            if state is not None:
                self._send(state.reference)
            rows.append(np.concatenate(([sample.stamp], pose, wrench)))
        table = np.array(rows)
        return FreeAir(table[:, 0], table[:, 1:4], table[:, 4:7])

    def ramp_to(
        self,
        goal: Float[np.ndarray, " 3"],
        allowed: float = RAMP_FORCE,
        before: Float[np.ndarray, " 2"] | None = None,
    ) -> None:
        """Straight to a pose; RobotError where a force grows by more than `allowed` [N] beyond what
        it was `before`, by default at the first reading."""
        rate, waited = self.link.rate, 0
        self._command = None
        while waited < ARRIVING * rate:
            _, pose, wrench = self.read()
            state = self.state or at_rest(pose, np.zeros(3))
            force = np.abs(wrench[:2])
            if before is None or not np.isfinite(before).all():
                before = force
            # Of a force that is no number a retreat knows nothing, and goes on.
            if bool((force - before > allowed).any()):
                raise RobotError(
                    f"the arm met a force of {force.max():.1f} N on its way through"
                    " what should be free air"
                )
            way = goal - state.reference
            steps = max(np.hypot(way[0], way[1]), abs(way[2]) / 10) / RAMP_SPEED * rate
            waited += steps < 1
            reference = state.reference + way / max(1.0, float(steps))
            self.state = at_rest(reference, wrench)
            self._send(reference)
        if not self._retreating:
            self._check_near(pose, ARRIVED)

    def retreat(self) -> FreeAir | None:
        """Away from what may be touched, to the left and up, then up; the arm holds where the way
        is not free. Returns what is read in the air, None where there was no room to leave what is
        touched, or no sensor tells.

        Both may be felt only through friction, or not at all where the sensor has drifted or
        stopped: so the way is the same whatever is felt.
        """
        assert self.state is not None, "never moved"
        here = self.state.reference
        above = lifted(self.settings, here)
        aside = here + np.array(
            [above[0] - here[0], min(above[1] - here[1], here[0] - above[0]), 0]
        )
        # The limit may be exceeded still: the ramp looks to the force.
        self._retreating = threading.get_ident()
        recent = np.array(self._recent)
        felt = np.abs(recent[:, 4:6]).max(0) if len(recent) else None
        try:
            self.ramp_to(aside, RETREAT_FORCE, felt)
            self.ramp_to(above, RETREAT_FORCE)
        finally:
            self._retreating = None
        rows = np.array(self._recent)
        rows = rows[rows[:, 0] > rows[-1, 0] - IN_AIR]
        free = is_lifted(self.settings, here, self.state.reference)
        if not free or self._frozen.any() or not np.isfinite(rows).all():
            return None
        return FreeAir(rows[:, 0], rows[:, 1:4], rows[:, 4:7])

    def settle(self, command: Float[np.ndarray, " 3"]) -> Reading:
        """Give way to a command until pose and force are steady, and average them."""
        rate = self.link.rate
        assert self.state is not None, "start first"
        window, last, began = Window(self.settling, self.noise), None, None
        law = replace(self._law, noise=tuple(self.noise.tolist()))
        self.state = for_new_command(self.state)
        way = command_way(self.state.reference if self._command is None else self._command, command)
        longest = self.settings.settle_time + travel_time(law, self.state, command)
        longest += self.settling.window  # which is taken after the first still one
        count, still, reached = 0, None, 0.0
        while still is None:
            sample, pose, wrench = self.read()
            began = sample.stamp if began is None else began
            passed = 1 / rate if last is None else sample.stamp - last
            last = sample.stamp
            step = min(passed, LARGEST_STEP)
            way = moved_on(way, law, self.state, step)
            self._command = way.command
            if reached < way.share and way.share >= min(reached + PROGRESS, 1.0):
                began, reached = sample.stamp, way.share
            state = advance(law, self.state, way.command, wrench, step)
            self.state = state
            self._send(state.reference)
            window.add(sample.stamp, pose, wrench, residual(law, state, command))
            count += 1
            if count % 12:
                continue
            if window.unstable():
                if self._slower < SLOWER_TURNS and window.swing < GENTLE:
                    self._slower += 1
                    self._law, law = turning_slower(self._law), turning_slower(law)
                    window, began = Window(self.settling, self.noise), sample.stamp
                    continue
                raise RobotError(
                    "the force oscillates: the surface is stiffer than stated, or the arm slower;"
                    f" state less than {self.settings.surface_mm_per_10n:g} mm per 10 N"
                )
            still = window.still()
            if still is None and sample.stamp - began > longest:
                if way.share < 1:
                    raise RobotError(
                        f"the command does not get on: the arm has not followed it beyond"
                        f" {way.share:.0%} of its way for {longest:.0f} s; look at what holds the"
                        " object, or state how much the surface yields"
                    )
                break
        settled = still is not None
        still = still or window.mean()
        if settled:
            self._check_near(still.pose, ARRIVED)
        return Reading(
            tensor_of(still.pose), tensor_of(still.wrench), settled, stamps=(still.start, still.end)
        )

    def check_inside(
        self, what: str, pose: Float[np.ndarray, " 3"], margin: tuple[float, ...] = (1e-9,) * 3
    ) -> None:
        """Raises RobotError for a pose outside of the workspace, give or take a margin."""
        low, high = (
            np.array(v) for v in (self.settings.workspace_low, self.settings.workspace_high)
        )
        # A NaN is inside of nothing.
        if not bool((pose >= low - margin).all() and (pose <= high + margin).all()):
            shown = ", ".join(f"{value:.3f}" for value in pose)
            raise RobotError(
                f"{what} is at ({shown}) [m, m, rad], outside of the workspace from"
                f" {self.settings.workspace_low} to {self.settings.workspace_high}"
            )

    def _send(self, reference: Float[np.ndarray, " 3"]) -> None:
        """The next target of the position servo, unless the arm was stopped meanwhile."""
        if self.halted and self._retreating != threading.get_ident():
            raise RobotError("the arm was told to stop")
        self.link.servo(tcp_of(self.frame, reference))


def tensor_of(values: np.ndarray) -> Tensor:
    """A float64 copy."""
    return torch.from_numpy(np.asarray(values, dtype=np.float64).copy())
