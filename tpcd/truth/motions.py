"""Motions that make episodes: touch-driven exploration and test trajectories.

A motion is asked for one command at a time and sees the history of what was measured, so
exploration needs no knowledge of theta: it feels for the floor and the wall. Commands stay
within `FORCE_LIMIT` of stiffness times the distance from the last measured pose. Poses and
commands (x, z, phi) [m, m, rad] in the world; wrenches [N, N, N·m].
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.errors import RobotError

FORCE_LIMIT = 8.0
"""Largest force on an axis if the arm were blocked where it stands [N]."""
TOUCH_FORCE = 1.2
"""A force beyond this is contact and not noise, at a sensor noise of about 0.3 N [N]."""
LARGEST_FRICTION = 0.9
"""Friction expected at most; more force along the floor than this must be the wall."""
LARGEST_DRAG = 2.0
"""Friction that the search for the wall makes up for by reaching further [N]."""
SEARCH_STEP_DOWN = 0.015
SEARCH_STEP_RIGHT = 0.035
"""Steps of the search for floor and wall [m]."""
LARGEST_TILT = 0.15
"""Largest commanded angle [rad]."""

START_OFF, START_TURNED = 5e-3, 0.05
"""An arm further than this from where a plan begins [m, rad] does not stand there."""

Script = Generator[tuple[float, float, float], "History", None]


@dataclass(frozen=True)
class History:
    """What was commanded and measured so far, k rows; row 0 is the free start pose."""

    commands: Float[Tensor, "k 3"]
    poses: Float[Tensor, "k 3"]
    wrenches: Float[Tensor, "k 3"]
    stiffness: Float[Tensor, " 3"]


@runtime_checkable
class Motion(Protocol):
    """Something that chooses the next command from what was measured."""

    def next_command(self, history: History) -> Float[Tensor, " 3"]:
        """Next command [m, m, rad]."""
        ...


class PlannedMotion:
    """A motion fixed beforehand: command k, whatever was measured."""

    def __init__(self, commands: Float[Tensor, "n 3"]) -> None:
        self.commands = commands

    def next_command(self, history: History) -> Float[Tensor, " 3"]:
        """Row k of the plan after k measured rows; row 0 is the start pose. `RobotError` where the
        arm does not stand there: the plan's ways and forces would be others."""
        step = history.commands.shape[0]
        away = (history.poses[0] - self.commands[0]).abs() if step == 1 else torch.zeros(3)
        if bool((away[:2] > START_OFF).any()) or float(away[2]) > START_TURNED:
            stands, asked = (
                ", ".join(f"{value:.3f}" for value in pose.tolist())
                for pose in (history.poses[0], self.commands[0])
            )
            raise RobotError(
                f"the arm stands at ({stands}), but the plan begins at ({asked}) [m, m, rad]: put"
                " the hand there, check the origin, or plan from where it stands",
                resumable=False,
            )
        if step >= len(self.commands):
            raise ValueError(f"the plan has {len(self.commands)} rows, asked for row {step}")
        return self.commands[step]


class ScriptedMotion:
    """A script that yields commands and is sent what was measured; forces are limited."""

    def __init__(self, script: Callable[[History], Script]) -> None:
        self._script = script
        self._running: Script | None = None

    def next_command(self, history: History) -> Float[Tensor, " 3"]:
        """Next command of the script, drawn back to within `FORCE_LIMIT` of the last pose."""
        if self._running is None:
            self._running = self._script(history)
            wanted = next(self._running)
        else:
            wanted = self._running.send(history)
        reach = (FORCE_LIMIT / history.stiffness[:2]).tolist()
        x, z, _ = history.poses[-1].tolist()
        return torch.tensor(
            [
                min(max(wanted[0], x - reach[0]), x + reach[0]),
                min(max(wanted[1], z - reach[1]), z + reach[1]),
                min(max(wanted[2], -LARGEST_TILT), LARGEST_TILT),
            ],
            dtype=torch.float64,
        )


def rich_exploration(generator: torch.Generator) -> ScriptedMotion:
    """The default: find the floor, press, tilt and slide on it, find the wall, work the corner.

    Reaches floor and wall within 15 steps for objects of a hand's size that start up to
    about 60 mm above the floor and 150 mm from the wall.
    """
    return ScriptedMotion(lambda history: _rich_script(history, generator))


def press_and_slide(generator: torch.Generator | None) -> ScriptedMotion:
    """The paper's basic trajectory: press on the floor and move right, with zero-mean
    perturbations of every command (arXiv 2409.17470, section V); without a generator, the
    basic trajectory itself."""
    return ScriptedMotion(lambda history: _press_and_slide_script(history, generator))


def _rich_script(history: History, generator: torch.Generator) -> Script:
    stiffness = history.stiffness.tolist()

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def press(low: float, high: float) -> float:
        return uniform(low, high) / stiffness[1]

    def tilt() -> float:
        return uniform(0.10, LARGEST_TILT)

    side = 1.0 if uniform(0.0, 1.0) < 0.5 else -1.0
    # Down to the floor. From here on x, z are the last measured place of the hand.
    history = yield from _descend(history)
    x, z, _ = history.poses[-1].tolist()
    # On the floor: tilt one way under load, slide left tilted the other way, press flat.
    history = yield (x, z - press(2.0, 3.5), side * tilt())
    x, z, _ = history.poses[-1].tolist()
    history = yield (x - uniform(0.02, 0.035), z - press(3.0, 4.0), -side * tilt())
    x, z, _ = history.poses[-1].tolist()
    history = yield (x + 0.01, z - press(4.0, 5.5), 0.0)
    # Right with a light load until more than friction holds the hand.
    while not _wall_is_felt(history):
        x, z, angle = history.poses[-1].tolist()
        floor_force = float(history.wrenches[-1, 1])
        depth = press(1.0, 2.0) if floor_force > TOUCH_FORCE / 2 else press(2.0, 3.0)
        drag = min(max(0.0, -float(history.wrenches[-1, 0])), LARGEST_DRAG) / stiffness[0]
        history = yield (x + SEARCH_STEP_RIGHT + drag, z - depth, 0.3 * angle)
    # In the corner, then along the wall, then anywhere near the corner at random.
    wall_press = 1.0 / stiffness[0]
    x, z, _ = history.poses[-1].tolist()
    history = yield (x + uniform(2.0, 4.0) * wall_press, z - press(2.5, 4.0), side * tilt())
    x, z, _ = history.poses[-1].tolist()
    history = yield (x + uniform(2.0, 4.0) * wall_press, z + uniform(0.02, 0.03), -side * tilt())
    x, z, _ = history.poses[-1].tolist()
    history = yield (x + uniform(3.0, 4.5) * wall_press, z + uniform(0.02, 0.03), side * tilt())
    x, z, _ = history.poses[-1].tolist()
    history = yield (x + uniform(2.0, 3.0) * wall_press, z - 0.04, 0.0)
    floor_z, wall_x = _lowest_and_furthest(history)
    while True:
        place = uniform(0.0, 1.0)
        on_floor, at_wall = place < 0.75, place > 0.45
        history = yield (
            wall_x + uniform(1.5, 4.5) * wall_press if at_wall else wall_x - uniform(0.02, 0.06),
            floor_z - press(2.0, 5.0) if on_floor else floor_z + uniform(0.01, 0.04),
            uniform(-LARGEST_TILT, LARGEST_TILT),
        )


def expert_motion(wall_position: float) -> ScriptedMotion:
    """The paper's expert: one trajectory for all objects, made with the true wall [m] in view.

    Down to the floor, tilt both ways under load, right to the wall in three strides, then
    press into the corner and up along the wall at alternating tilts.
    """
    return ScriptedMotion(lambda history: _expert_script(history, wall_position))


def _expert_script(history: History, wall_position: float) -> Script:
    stiffness = history.stiffness.tolist()
    history = yield from _descend(history)
    x, floor_z, _ = history.poses[-1].tolist()
    deep, light = floor_z - 4.0 / stiffness[1], floor_z - 2.0 / stiffness[1]
    for tilt in (0.12, -0.12):
        history = yield (x, deep, tilt)
    stride = (wall_position - x) / 3
    while not _wall_is_felt(history):
        history = yield (history.poses[-1].tolist()[0] + stride, light, 0.0)
    wall_x = history.poses[-1].tolist()[0]
    push = 3.5 / stiffness[0]
    corner = ((push, deep, 0.12), (push, deep, -0.12), (push, floor_z + 0.03, -0.12))
    above = ((push, floor_z + 0.03, 0.12), (-0.03, deep, 0.0), (-0.03, deep, 0.12))
    while True:
        for offset, z, tilt in (*corner, *above):
            history = yield (wall_x + offset, z, tilt)


def _press_and_slide_script(history: History, generator: torch.Generator | None) -> Script:
    history = yield from _descend(history)
    x, floor_z, _ = history.poses[-1].tolist()
    depth = 3.0 / history.stiffness.tolist()[1]
    while True:
        noise = [0.0, 0.0, 0.0]
        if generator is not None:
            noise = torch.randn(3, generator=generator, dtype=torch.float64).tolist()
        if not _wall_is_felt(history):
            drag = min(max(0.0, -float(history.wrenches[-1, 0])), LARGEST_DRAG)
            x = (
                history.poses[-1].tolist()[0]
                + SEARCH_STEP_RIGHT
                + drag / float(history.stiffness[0])
            )
        history = yield (x + 0.005 * noise[0], floor_z - depth + 0.005 * noise[1], 0.04 * noise[2])


def _descend(history: History) -> Generator[tuple[float, float, float], History, History]:
    """Lower the command until the floor is felt."""
    x, z, angle = history.commands[-1].tolist()
    while float(history.wrenches[-1, 1]) < TOUCH_FORCE:
        z -= min(SEARCH_STEP_DOWN, 3.0 / float(history.stiffness[1]))
        history = yield (x, z, angle)
    return history


def _wall_is_felt(history: History) -> bool:
    """Whether something pushes left harder than floor friction could."""
    force_x, force_z, _ = history.wrenches[-1].tolist()
    return -force_x > LARGEST_FRICTION * max(force_z, 0.0) + TOUCH_FORCE


def _lowest_and_furthest(history: History) -> tuple[float, float]:
    return float(history.poses[:, 1].min()), float(history.poses[:, 0].max())


def planned_test(
    vertices_ee: Float[Tensor, "p 2"],
    floor_height: float,
    wall_position: float,
    start_pose: Float[Tensor, " 3"],
    steps: int,
    generator: torch.Generator,
    stiffness: Float[Tensor, " 3"],
) -> PlannedMotion:
    """A smooth random trajectory of `steps` commands after the start pose, to test on.

    It visits free space, the floor, the wall and both at once in random order, between
    them easing along a cosine; tilts within 0.15 rad, commands up to 5 N deep on an axis.
    It is planned with knowledge of the scene, unlike exploration.
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}, expected at least 1")
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
    vertices = vertices_ee.numpy()
    depth = 5.0 / stiffness.numpy()[:2]
    legs = max(1, min(5, steps // 4)) if steps < 24 else max(5, steps // 6)
    order = np.concatenate([rng.permutation(4) for _ in range(legs // 4 + 1)])[:legs]
    start = start_pose.numpy()
    waypoints = [start]
    for place in order:
        angle = rng.uniform(-LARGEST_TILT, LARGEST_TILT)
        turned = vertices @ np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        floor_z = floor_height - turned[:, 1].min()
        wall_x = wall_position - turned[:, 0].max()
        on_floor, at_wall = place in (1, 3), place in (2, 3)
        # Deep enough that turning on one contact does not lose the other.
        press_x, press_z = rng.uniform(0.4 if place == 3 else 0.1, 1, 2) * depth
        free_x = rng.uniform(min(wall_x, start[0]) - 0.04, wall_x - 0.01)
        free_z = floor_z + rng.uniform(0.005, 0.04)
        x = wall_x + press_x if at_wall else free_x
        z = floor_z - press_z if on_floor else free_z
        waypoints.append(np.array([x, z, angle]))
    times = np.linspace(0, legs, steps + 1)
    leg = np.minimum(times.astype(int), legs - 1)
    eased = ((1 - np.cos(np.pi * (times - leg))) / 2)[:, None]
    points = np.array(waypoints)
    return PlannedMotion(torch.from_numpy(points[leg] + eased * (points[leg + 1] - points[leg])))
