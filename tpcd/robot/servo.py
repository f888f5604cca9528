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
from jaxtyping import Float
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
"""A wrench that repeats exactly for so long [s], and for longer than its own habit in free air
allows, is of a sensor that has stopped."""
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
        self.longest_repeat = np.inf
        """Readings of a working sensor that may repeat one wrench."""
        self._over, self._slower, self._repeated = 0, 0, 0
        self._last_wrench: np.ndarray | None = None
        self._retreating: int | None = None
        """Thread that makes the arm retreat."""
        self._felt: deque[np.ndarray] = deque(maxlen=max(1, round(RECENT * link.rate)))
        """Sizes of the last forces (2) [N]."""
        self._command: np.ndarray | None = None
        """The last one given way to; None where the arm went elsewhere since."""

    def read(self) -> tuple[Sample, Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """The next reading, checked and recorded."""
        self._signals.look()
        frame, state = self.frame, self.state
        sample = self.link.next_sample()
        self._check_alive(sample)
        pose, wrench = planar_pose(frame, sample.tcp), planar_wrench(frame, sample.wrench)
        reference = pose if state is None else state.reference
        # What cannot be kept ends a move, and no retreat.
        with suppress(Exception) if self._retreating else nullcontext():
            self.record.add(sample, pose, wrench, reference)
        self._felt.append(np.abs(wrench[:2]))
        limit = self.settings.stop_force * np.array([1.0, 1.0, 0.2])
        over = bool((np.abs(wrench) > limit).any()) and not self._retreating
        self._over = self._over + 1 if over else 0
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
        self.check_inside("the arm", pose, MARGIN)
        return sample, pose, wrench

    def _check_alive(self, sample: Sample) -> None:
        """Raises RobotError for readings that are no numbers, and for a wrench that has frozen."""
        if not (np.isfinite(sample.tcp).all() and np.isfinite(sample.wrench).all()):
            raise RobotError(
                f"a reading that is no number: pose {sample.tcp.tolist()}, wrench"
                f" {sample.wrench.tolist()}"
            )
        same = self._last_wrench is not None and np.array_equal(sample.wrench, self._last_wrench)
        self._repeated = self._repeated + 1 if same else 0
        self._last_wrench = np.array(sample.wrench)
        frozen = self._repeated > max(FROZEN * self.link.rate, self.longest_repeat)
        if frozen and not self._retreating:
            raise RobotError(
                f"the force sensor repeats {self._last_wrench[:3].tolist()} N exactly, where single"
                f" readings scatter by {self.noise[:2].max():.2g} N: it has stopped"
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
            before = force if before is None else before
            if float((force - before).max()) > allowed:
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

    def retreat(self) -> Float[np.ndarray, " 3"]:
        """Away from what may be touched, then up; the arm holds where the way is not free.

        The world has a floor below and a wall on the right, and both may be felt only through
        friction. So the way is up, and at first also to the left where the arm is pushed there.
        """
        assert self.state is not None, "never moved"
        settings, here = self.settings, self.state.reference
        # The limit may be exceeded still: the ramp looks to the force.
        self._retreating = threading.get_ident()
        felt = np.max(self._felt, axis=0) if self._felt else None
        left = -1.0 if float(self.state.wrench[0]) < -1.0 else 0.0
        low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
        try:
            for way in (np.array([left, 1.0, 0.0]), np.array([0.0, 1.0, 0.0])):
                goal = here + 0.5 * settings.retreat * way
                goal = np.clip(goal, np.minimum(low, here), np.maximum(high, here))
                self.ramp_to(goal, RETREAT_FORCE, felt)
                here, felt = self.state.reference, None
        finally:
            self._retreating = None
        return here

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
