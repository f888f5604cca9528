"""The springs of an impedance controller as a recording shows them: x - u beside the wrench.

In equilibrium w = K (x - u) whatever is touched. Rotations are small enough to be vectors:
rotation vector of x relative to u, in the same axes as the positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tpcd.identification.blocks import block_edges, correlation_time
from tpcd.identification.rests import SHORTEST, recorded_axes
from tpcd.logs.log import AXES, Log

MOST = 20_000
"""Samples that are looked at; more are thinned out evenly."""
OVER = 0.1
"""Speed is taken over so long [s]."""
NOISY, SLOW = 3.0, 0.002
"""An arm moves where its speed is so many standard deviations of noise, and so much of its largest
speed. What slides slower counts as held, and friction beside damping is told by what is slow."""


@dataclass(frozen=True, eq=False)
class Springs:
    """n samples of a recording with commands, thinned out."""

    log: Log
    """The samples looked at."""
    every: int
    """How many samples of the recording each stands for."""

    @cached_property
    def frames(self) -> Float[np.ndarray, "n 3 3"]:
        """From axes of the end effector to the world's."""
        return self.log.rotations.as_matrix()

    @cached_property
    def away(self) -> Float[np.ndarray, "n 6"]:
        """x - u in axes of the world [m, rad]."""
        log = self.log
        assert log.command_positions is not None
        turned = log.command_rotations or log.rotations
        turn = (log.rotations * turned.inv()).as_rotvec()
        return np.concatenate((log.positions - log.command_positions, turn), axis=1)

    @property
    def sparse(self) -> bool:
        """Whether rows were read one by one, at rest: what moves does so between them."""
        return self.step >= SHORTEST

    def rates(self, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """How fast columns change; of rows read at rest, since the row before."""
        if not self.sparse:
            return np.gradient(values, self.log.times, axis=0)
        steps = np.diff(values, axis=0) / np.diff(self.log.times)[:, None]
        return np.concatenate((np.zeros_like(steps[:1]), steps))

    @cached_property
    def asked(self) -> Float[np.ndarray, "n 6"]:
        """Velocity of the command, in axes of the world [m/s, rad/s]."""
        log = self.log
        assert log.command_positions is not None
        linear = self.rates(log.command_positions)
        angular = np.zeros_like(linear)
        if log.command_rotations is not None:
            turn = log.command_rotations[1:] * log.command_rotations[:-1].inv()
            angular[1:] = turn.as_rotvec() / np.diff(log.times)[:, None]
        return np.concatenate((linear, angular), axis=1)

    @cached_property
    def directions(self) -> Float[np.ndarray, "n 6"]:
        """Which way friction of the arm holds each of its coordinates, in axes of the world: 1 or
        -1 while it moves, and after that for as long as the command rests; else 0, for it may hold
        either way."""
        log, count = self.log, len(self.log)
        span = min(max(1, round(OVER / 2 / self.step)), count // 3)
        if span < 1:
            return np.zeros((count, 6))
        first = np.clip(np.arange(count) - span, 0, None)
        last = np.clip(np.arange(count) + (0 if self.sparse else span), None, count - 1)
        quaternions = log.rotations.as_quat()
        before, after = (Rotation.from_quat(quaternions[k]) for k in (first, last))
        turn = (after * before.inv()).as_rotvec()
        moved = np.concatenate((log.positions[last] - log.positions[first], turn), axis=1)
        speeds = moved / np.maximum(log.times[last] - log.times[first], 1e-12)[:, None]
        steps = (log.rotations[1:] * log.rotations[:-1].inv()).as_rotvec()
        single = np.concatenate((np.diff(log.positions, axis=0), steps), axis=1)
        # Second differences hold little motion: their median is 0.6745 sqrt(6) deviations.
        noise = np.median(np.abs(np.diff(single, axis=0)), axis=0) / 1.65
        least = NOISY * noise * 2**0.5 / (2 * span * self.step)
        least = np.maximum(np.maximum(least, SLOW * np.abs(speeds).max(0)), 1e-12)
        ways = np.where(np.abs(speeds) > least, np.sign(speeds), 0.0)
        if not self.sparse:
            # A reversal within the time that a speed is taken over is no motion yet.
            near = span // 2
            padded = np.pad(ways, ((near, near), (0, 0)), mode="edge")
            ways = np.where((padded[:count] == ways) & (padded[2 * near :] == ways), ways, 0.0)
        order = np.arange(count)[:, None]
        moved = np.maximum.accumulate(np.where(ways != 0, order, -1))
        asked = np.maximum.accumulate(np.where(np.abs(self.asked) > least, order, -1))
        held = (moved >= 0) & ((moved == order) | (asked <= moved))
        return np.where(held, np.take_along_axis(ways, np.maximum(moved, 0), axis=0), 0.0)

    @property
    def step(self) -> float:
        """Median time between the samples looked at [s]."""
        return float(np.median(np.diff(self.log.times)))

    @cached_property
    def edges(self) -> Int[np.ndarray, " B"]:
        """Where blocks begin that are long beside what readings share."""
        readings = (*self.log.forces.T, *self.log.torques.T)
        times = [correlation_time(column) for column in readings if np.ptp(column) > 0]
        return block_edges(len(self.log), float(np.median(times)) if times else 1.0)

    def turned(self, values: Float[np.ndarray, "n 3"], axes: str) -> Float[np.ndarray, "n 3"]:
        """Vectors of the world in axes of `axes`: world or tool."""
        return values if axes == "world" else np.einsum("nji,nj->ni", self.frames, values)

    def in_world(self, values: Float[np.ndarray, "n 3"], frame: str) -> Float[np.ndarray, "n 3"]:
        """Vectors in axes of `frame` in those of the world."""
        return values if frame == "world" else np.einsum("nij,nj->ni", self.frames, values)

    @cached_property
    def spread(self) -> float:
        """How far the end effector turned, at most, from where it was in the middle [rad]."""
        middle = self.log.rotations.mean()
        return float((middle.inv() * self.log.rotations).magnitude().max())

    def axes(self, letter: str) -> tuple[int, ...]:
        """Axes of which both reading and set point were recorded; `letter` is F or T."""
        if letter == "F":
            gone = {k for k, axis in enumerate(AXES) if f"u_{axis}" in self.log.missing}
        else:
            gone = set() if self.log.command_rotations is not None else {0, 1, 2}
        return tuple(k for k in recorded_axes(self.log, letter) if k not in gone)


def springs(log: Log) -> Springs | None:
    """The usable samples of a recording, thinned out; None where it has no commands."""
    if log.command_positions is None or log.usable.sum() < 2:
        return None
    kept = np.flatnonzero(log.usable)
    every = -(-len(kept) // MOST)
    mask = np.zeros(len(log), dtype=bool)
    mask[kept[::every]] = True
    return Springs(log.only(mask), every)
