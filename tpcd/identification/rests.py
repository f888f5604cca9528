"""Readings that count as one observation each: rests of an arm, or blocks of time.

Samples that follow each other share drift, creep and slow noise, so a thousand of them in one pose
say little more than one. What weighs the load takes one mean for each rest or block, and learns its
error from how they scatter about the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tpcd.logs.log import AXES, Log

BIN, SHORTEST = 0.25, 1.0
"""Motion is looked at in bins of so many seconds; a rest lasts at least so long [s]. Rows farther
apart than the shortest rest were read one by one: each is a rest of its own."""
STILL_POSITION, STILL_ANGLE = 5e-4, 2e-3
"""An arm that moves less from bin to bin stands still [m, rad]: 2 mm/s and half a degree a second,
far above the noise of encoders and far below any motion on purpose."""
SAME = np.radians(3.0)
"""Rests whose upward directions differ by less count as one [rad]: what a sensor is off by in one
orientation, it is off by there again."""
UP = (0.0, 0.0, 1.0)
"""Against gravity, in the recording's world."""


@dataclass(frozen=True, eq=False)
class Observed:
    """r means of what the sensor read, in axes of the end effector."""

    up: Float[np.ndarray, "r 3"]
    """The world's upward direction in axes of the end effector; shorter than 1 where it turned."""
    forces: Float[np.ndarray, "r 3"]
    torques: Float[np.ndarray, "r 3"]
    times: Float[np.ndarray, " r"]
    force_axes: tuple[int, ...] = (0, 1, 2)
    """Which components were recorded."""
    torque_axes: tuple[int, ...] = (0, 1, 2)
    pressed: Float[np.ndarray, "r 3"] | None = None
    """Force of the world that is known besides, K (x - u), in axes of the end effector [N]."""
    twisted: Float[np.ndarray, "r 3"] | None = None
    """The same of the torque about the end effector's origin [N·m]."""
    edges: Int[np.ndarray, " B"] | None = None
    """Where blocks of time begin, if neighbours share errors: then blocks count, not samples."""

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.up)

    def merged(self) -> Observed:
        """One observation for each orientation: the mean of those that share it."""
        groups: list[list[int]] = []
        for k, up in enumerate(self.up):
            near = (g for g in groups if np.linalg.norm(self.up[g[0]] - up) < SAME)
            group = next(near, None)
            groups.append([k]) if group is None else group.append(k)

        def means(values: np.ndarray) -> np.ndarray:
            return np.array([values[group].mean(0) for group in groups]).reshape(
                len(groups), *values.shape[1:]
            )

        return replace(
            self,
            up=means(self.up),
            forces=means(self.forces),
            torques=means(self.torques),
            times=means(self.times),
        )


def recorded_axes(log: Log, letter: str) -> tuple[int, ...]:
    """Which components of F or T (`letter`) hold readings, with axes of the tool or the world.

    One that never changes holds none. Where missing ones would mix with others as the arm turns,
    none is left.
    """
    values = log.forces if letter == "F" else log.torques
    kept = tuple(
        k
        for k, axis in enumerate(AXES)
        if f"{letter}_{axis}" not in log.missing and np.ptp(values[:, k]) > 0
    )
    if len(kept) in (0, 3):
        return kept
    if letter == "F" and len(kept) < 2:
        return ()
    turns = log.rotations.as_matrix()
    mixed = [abs(turns[:, i, j]).max() for i in kept for j in range(3) if j not in kept]
    return kept if max(mixed) < 1e-6 else ()


def find_rests(log: Log) -> list[tuple[int, int]]:
    """First sample of each stretch in which the pose stood still, and the one after its last."""
    kept = np.flatnonzero(log.usable)
    if len(kept) < 2:
        return []
    if np.median(np.diff(log.times[kept])) >= SHORTEST:
        return [(int(k), int(k) + 1) for k in kept]
    bins = np.floor((log.times - log.times[0]) / BIN).astype(int)
    bins[~log.usable] = -1
    present, first = np.unique(bins[kept], return_index=True)
    if len(present) < 2:
        return []
    edges = np.append(first, len(kept))
    counts = np.diff(edges)
    places = np.add.reduceat(log.positions[kept], first, axis=0) / counts[:, None]
    turns = Rotation.from_quat(log.rotations.as_quat()[kept[first + counts // 2]])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    turned = (turns[1:] * turns[:-1].inv()).magnitude()
    near = np.diff(present) <= max(1, round(2 * np.median(np.diff(present))))
    still = (moved < STILL_POSITION) & (turned < STILL_ANGLE) & near
    change = np.flatnonzero(np.diff(np.concatenate(([0], still.astype(int), [0]))))
    rests = []
    for begin, end in change.reshape(-1, 2):
        rest = int(kept[edges[begin]]), int(kept[edges[end + 1] - 1]) + 1
        if log.times[rest[1] - 1] - log.times[rest[0]] >= SHORTEST:
            rests.append(rest)
    return rests


def observe_rests(log: Log, rests: list[tuple[int, int]], frame: str) -> Observed:
    """The mean reading of the later half of rests, when creep after a turn has gone on,
    one for each orientation.

    `frame` says in which axes the recording gives the wrench: world or tool.
    """
    halves = [np.arange((a + b) // 2 if b - a > 1 else a, b) for a, b in rests]
    usable = log.usable
    groups = [half[usable[half]] for half in halves]
    into_tool = log.rotations.inv()
    turned = frame == "world"
    forces = into_tool.apply(log.forces) if turned else log.forces
    torques = into_tool.apply(log.torques) if turned else log.torques
    kept = [group for group in groups if len(group)]

    def means(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "r k"]:
        return np.array([values[group].mean(0) for group in kept]).reshape(-1, values.shape[1])

    return Observed(
        means(into_tool.apply(UP)),
        means(forces),
        means(torques),
        means(log.times[:, None])[:, 0],
        recorded_axes(log, "F"),
        recorded_axes(log, "T"),
    ).merged()
