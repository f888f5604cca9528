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

from tpcd.logs.log import AXES, Log
from tpcd.quality.blocks import block_edges, correlation_time
from tpcd.quality.rests import recorded_axes

MOST = 20_000
"""Samples that are looked at; more are thinned out evenly."""
TURNED = 4.0
"""Motion counts as a new direction once it goes back by so many standard deviations of noise."""


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

    @cached_property
    def asked(self) -> Float[np.ndarray, "n 6"]:
        """Velocity of the command, in axes of the world [m/s, rad/s]."""
        log = self.log
        assert log.command_positions is not None
        linear = np.gradient(log.command_positions, log.times, axis=0)
        angular = np.zeros_like(linear)
        if log.command_rotations is not None:
            turn = log.command_rotations[1:] * log.command_rotations[:-1].inv()
            angular[1:] = turn.as_rotvec() / np.diff(log.times)[:, None]
        return np.concatenate((linear, angular), axis=1)

    @cached_property
    def directions(self) -> Float[np.ndarray, "n 6"]:
        """Which way each of the arm's coordinates moved last: 1, -1, or 0 before it ever did."""
        start = self.log.rotations[0]
        turn = (self.log.rotations * start.inv()).as_rotvec()
        moved = np.concatenate((self.log.positions, turn), axis=1)
        return np.stack([_direction(column) for column in moved.T], axis=1)

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


def _direction(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    steps = np.abs(np.diff(values))
    moving = steps[steps > 0]
    # A tenth of the steps are between samples at rest, where there are any.
    noise = float(np.quantile(moving, 0.1)) if len(moving) else 0.0
    reach = max(TURNED * noise, 1e-3 * float(np.ptp(values)))
    told, way, extreme = np.zeros(len(values)), 0.0, values[0]
    for k, value in enumerate(values):
        if way >= 0 and value < extreme - reach:
            way, extreme = -1.0, value
        elif way <= 0 and value > extreme + reach:
            way, extreme = 1.0, value
        elif (value - extreme) * way > 0:
            extreme = value
        told[k] = way
    return told
