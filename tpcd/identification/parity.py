"""Stiffness, friction and frames from w - K (x - u).

For each axis, in axes in which the controller's stiffness is diagonal,

    w = K e + zero + c sign(motion) + D (de/dt) + G (du/dt),    e = x - u.

Both sides are noisy: friction of the arm is in e, drift of the sensor in w. Fitting w to e gives a
stiffness that is too small, fitting e to w one that is too large, and what is true lies between
them (Frisch 1934); the intervals hold both ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tpcd.identification.blocks import (
    Estimate,
    block_edges,
    correlation_time,
    jackknife,
    moments,
    partial,
    solve,
)
from tpcd.identification.springs import Springs
from tpcd.logs.log import AXES

WIDE = np.radians(10.0)
"""An end effector that turned less shows nothing of which axes a wrench is in [rad]."""

STRAIGHT = 0.003
"""Part of a stiffness by which intervals are wider, either way: friction that sticks and commands
that move while a pose lags are not the straight lines that are fitted (0.1 to 0.3 % in made
recordings of arms that do both)."""
OWN = 6
"""Columns w, e, 1, direction, rates of e and u come first; what the axes share comes after."""


@dataclass(frozen=True, eq=False)
class Axis:
    """One axis of w = K e + zero + c sign(motion) + D (de/dt)."""

    letter: str
    index: int
    low: Estimate
    """K by fitting w to e."""
    high: Estimate
    """K by fitting e to w."""
    zero: tuple[Estimate, Estimate]
    """What is left at e = 0 with either K."""
    friction: tuple[Estimate, Estimate]
    others: Float[np.ndarray, " 3"]
    """Coefficients of the sign of motion and of the rates of e and u, between both ends."""
    explained: float
    """Part of the variance of w that e explains."""
    time: float
    """How many samples apart readings are independent, for what e explains."""

    @property
    def name(self) -> str:
        """x, y, z, rx, ry, rz."""
        return ("" if self.letter == "F" else "r") + AXES[self.index]

    @property
    def interval(self) -> tuple[float, float]:
        """Of the stiffness."""
        ends = (*self.low.bounds(), *self.high.bounds())
        margin = STRAIGHT * abs(self.stiffness)
        return float(min(ends)) - margin, float(max(ends)) + margin

    @property
    def stiffness(self) -> float:
        """Between both ends, in ratio."""
        low, high = float(self.low.value), float(self.high.value)
        return float(np.sign(low) * np.sqrt(abs(low * high)))

    @property
    def told(self) -> bool:
        """Whether e explains anything of w."""
        low, high = self.interval
        return bool(low * high > 0 and np.isfinite(high))


@dataclass(frozen=True, eq=False)
class Parity:
    """The springs of a recording in one pair of frames."""

    springs: Springs
    frame: str
    """Axes in which the wrench is given: world or tool."""
    axes: str
    """Axes in which the stiffness is diagonal."""
    told: tuple[Axis, ...]
    left: Float[np.ndarray, " B"]
    """Sum of squares of what is left of the forces in each block [N^2]."""

    @property
    def sign(self) -> float:
        """-1 where the wrench is what the arm exerts, in most axes that tell; else 1."""
        told = [np.sign(float(axis.low.value)) for axis in self.told if axis.told]
        return -1.0 if sum(told) < 0 else 1.0

    def stiffness(self) -> tuple[Float[np.ndarray, " 6"], ...]:
        """Of each axis with the sign of the wrench: what fits best, and both ends of the interval;
        0 where the data cannot tell."""
        found = np.zeros((3, 6))
        for axis in self.told:
            if axis.told:
                at = axis.index + (3 if axis.letter == "T" else 0)
                found[:, at] = (axis.stiffness, *axis.interval)
        return tuple(found)


def readings(springs: Springs, letter: str, frame: str, axes: str) -> Float[np.ndarray, "n 3"]:
    """Forces or torques, given in axes of `frame`, in axes of `axes`."""
    given = springs.log.forces if letter == "F" else springs.log.torques
    return given if frame == axes else springs.turned(springs.in_world(given, frame), axes)


def displacements(springs: Springs, letter: str, axes: str) -> Float[np.ndarray, "n 3"]:
    """The springs' part that goes with the letter, in axes of `axes`."""
    away = springs.away[:, :3] if letter == "F" else springs.away[:, 3:]
    return springs.turned(away, axes)


def spring_wrench(
    parity: Parity, letter: str, stiffness: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "n 3"]:
    """What the world presses with, by the springs [N or N·m], in axes of the stiffness: K e, and
    what friction, damping and lag of the arm add to it; 0 along axes that are not told."""
    springs, axes = parity.springs, parity.axes
    found = displacements(springs, letter, axes) * stiffness
    for axis in parity.told:
        if axis.letter == letter and stiffness[axis.index]:
            columns = _nuisance(springs, letter, axis.index, parity.frame, axes)[1 : OWN - 2]
            found[:, axis.index] += np.column_stack(columns) @ axis.others
    return found


def fit_parity(springs: Springs, frame: str, axes: str) -> Parity:
    """Fit every axis of which reading and set point were recorded."""
    told, left = [], np.zeros(len(springs.edges))
    for letter in "FT":
        for k in springs.axes(letter):
            found = _axis(springs, letter, k, frame, axes)
            if found is None:
                continue
            axis, squares = found
            told.append(axis)
            if letter == "F":
                left += squares
    return Parity(springs, frame, axes, tuple(told), left)


def _axis(
    springs: Springs, letter: str, k: int, frame: str, axes: str
) -> tuple[Axis, Float[np.ndarray, " B"]] | None:
    wrench = readings(springs, letter, frame, axes)[:, k]
    away = displacements(springs, letter, axes)[:, k]
    if np.ptp(away) == 0 or np.ptp(wrench) == 0:
        return None
    columns = np.column_stack((wrench, away, *_nuisance(springs, letter, k, frame, axes)))
    whole = columns.T @ columns
    weights = np.append(1.0, -solve(whole[1:, 1:], whole[1:, :1])[:, 0])
    left = columns @ weights
    time = correlation_time(left * (away - away.mean()))
    sums = moments(columns, block_edges(len(away), time))

    def ends(products: np.ndarray) -> np.ndarray:
        inner = partial(products, 2)
        low = inner[0, 1] / inner[1, 1] if inner[1, 1] > 0 else np.nan
        high = inner[0, 0] / inner[0, 1] if inner[0, 1] else np.inf
        found = [low, high]
        for slope in (low, high):
            right = products[2:, 0] - slope * products[2:, 1]
            # Bias and weight belong to the zero, but not to friction.
            zero = solve(products[2:OWN, 2:OWN], right[: OWN - 2, None])[0, 0]
            found += [zero, *solve(products[2:, 2:], right[:, None])[1 : OWN - 2, 0]]
        return np.array(found)

    with np.errstate(invalid="ignore"):
        found = jackknife(ends, sums)
    parts = found.parts()
    inner = partial(whole, 2)
    explained = float(inner[0, 1] ** 2 / max(inner[0, 0] * inner[1, 1], 1e-300))
    zero, friction = (parts[2], parts[6]), (parts[3], parts[7])
    others = (found.value[3:6] + found.value[7:10]) / 2
    axis = Axis(letter, k, parts[0], parts[1], zero, friction, others, explained, time)
    return axis, np.add.reduceat(left**2, springs.edges)


def _nuisance(
    springs: Springs, letter: str, k: int, frame: str, axes: str
) -> list[Float[np.ndarray, " n"]]:
    """What else is in w: zero, friction, damping, lag; bias and weight where the arm turned; and
    what a rotated sensor, or one that torques are about another point of, mixes in."""
    away = displacements(springs, letter, axes)
    column = k + (3 if letter == "T" else 0)
    rate = springs.rates(away[:, k : k + 1])[:, 0]
    asked = springs.turned(springs.asked[:, :3] if column < 3 else springs.asked[:, 3:], axes)
    found = [np.ones(len(away)), _directions(springs, column, axes), rate, asked[:, k]]
    if springs.spread > WIDE:
        # A bias turns with the tool, a weight does not; about another point it turns both ways.
        turn = springs.frames
        rows = turn[:, k] if axes == "world" else turn[:, :, k]
        found += list((rows if letter == "F" else turn.reshape(len(turn), 9)).T)
    for mixed in ("F",) if letter == "F" else ("T", "F"):
        found += list(_mixed(springs, mixed, k, frame, axes).T)
    return found


def _mixed(
    springs: Springs, letter: str, k: int, frame: str, axes: str
) -> Float[np.ndarray, "n 3"]:
    """What small rotations of the sensor about each axis of the end effector, or levers along them,
    bring from other components of a reading into the k-th."""
    other, third = (k + 1) % 3, (k + 2) % 3
    reading = readings(springs, letter, frame, axes)
    turn = springs.frames if axes == "world" else np.broadcast_to(np.eye(3), springs.frames.shape)
    return turn[:, other] * reading[:, third, None] - turn[:, third] * reading[:, other, None]


def _directions(springs: Springs, column: int, axes: str) -> Float[np.ndarray, " n"]:
    part = springs.directions[:, :3] if column < 3 else springs.directions[:, 3:]
    return springs.turned(part, axes)[:, column % 3]


def choose_frames(springs: Springs) -> tuple[Parity, bool, bool]:
    """The pair of frames that leaves least of the forces, and whether that of the wrench and that
    of the stiffness are told: whether another leaves more in blocks throughout."""
    frames = ("world", "tool")
    if springs.spread < 1e-6 or len(springs.axes("F")) < 2:
        return fit_parity(springs, "world", "world"), False, False
    tried = {(f, a): fit_parity(springs, f, a) for f in frames for a in frames}
    best = min(tried.values(), key=lambda each: each.left.sum())
    other = {"world": "tool", "tool": "world"}

    def surer(rival: Parity) -> bool:
        gain = jackknife(
            lambda sums: np.log(sums[1] / sums[0]) if (sums > 0).all() else np.array(0.0),
            np.stack((best.left, rival.left), axis=1),
        )
        return bool(gain.bounds()[0] > 0)

    if springs.spread < WIDE:
        return best, False, False
    rivals = [tried[other[best.frame], a] for a in frames]
    wrench = all(surer(rival) for rival in rivals)
    return best, wrench, all(surer(tried[f, other[best.axes]]) for f in frames)
