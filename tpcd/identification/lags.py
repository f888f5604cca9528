"""How far the pose comes after the command, and the wrench after the pose.

A lag is the shift at which one series explains most of the other; its interval is what leaving out
one block of time after another changes. Delays of clocks, time constants and damping shift alike,
so their sum is what is told.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tpcd.identification.blocks import block_edges, correlation_time, jackknife
from tpcd.identification.parity import Parity, displacements, readings
from tpcd.identification.quantity import Quantity
from tpcd.identification.springs import Springs

LONGEST = 0.5
"""Shifts that are looked at, either way [s]."""
FINEST = 80
"""How many either way, at most."""
EXPLAINED = 0.2
"""The best shift explains so much, or the lag is not told."""
MOVING = 0.2
"""Part of the time for which the arm goes on the same way, below which all of it counts."""
RESOLVED = 0.5
"""Part of the time between samples that no interval is narrower than, either way: friction and
noise bend the curve between two shifts."""
HORIZON = 0.1
"""Motion is compared over at least this time [s]: it has its lag whatever else stands off."""


def pose_lag(parity: Parity) -> Quantity:
    """How long the pose comes after the command [s], once what the wrench pushes it by is
    taken away."""
    springs = parity.springs
    name, motion = (
        "pose_lag",
        "move freely to and fro at the speed of use, sampled at 20 Hz or more",
    )
    reason = _sparse(springs)
    if reason:
        return Quantity(name, "s", reason=reason, motion=motion)
    log, times = springs.log, springs.log.times
    commands = log.command_positions
    assert commands is not None
    span = max(1, round(HORIZON / springs.step))
    kept = [k for k in range(3) if np.ptp(commands[:, k]) > 0]
    if not kept:
        return Quantity(name, "s", reason="the command never moves", motion=motion)
    moved = (log.positions[span:] - log.positions[:-span])[:, kept]
    force = readings(springs, "F", parity.frame, "world")
    pushed = (force[span:] - force[:-span])[:, kept]
    ways = springs.directions[:, kept]
    # A reversal takes up what friction holds, which looks like a lag.
    on = (ways[span:] * ways[:-span] > 0).astype(float)
    if on.mean() < MOVING:
        on = np.ones_like(on)

    def asked(shift: float) -> Float[np.ndarray, "k c"]:
        late = _at(times - shift, times, commands[:, kept])
        return _besides(on * (late[span:] - late[:-span]), on * pushed)

    moved, pushed = on * moved, on * pushed
    return _lag(springs, name, motion, _besides(moved, pushed), asked, "", centre=False)


def _besides(
    values: Float[np.ndarray, "k c"], others: Float[np.ndarray, "k c"]
) -> Float[np.ndarray, "k c"]:
    """What is left of each column once its other is fitted away."""
    size = (others**2).sum(0)
    return values - others * (values * others).sum(0) / np.where(size > 0, size, 1.0)


def wrench_lag(parity: Parity) -> Quantity:
    """How long the wrench comes after x - u [s]; damping looks like the opposite."""
    springs = parity.springs
    name, motion = "wrench_lag", "press and let go at several speeds, sampled at 20 Hz or more"
    told = {
        letter: [axis.index for axis in parity.told if axis.letter == letter and axis.told]
        for letter in "FT"
    }
    reason = _sparse(springs)
    if not reason and not any(told.values()):
        reason = "the wrench does not go with x - u"
    if reason:
        return Quantity(name, "s", reason=reason, motion=motion)
    wrench, away = (
        np.concatenate([part(letter)[:, kept] for letter, kept in told.items()], axis=1)
        for part in (
            lambda letter: readings(springs, letter, parity.frame, parity.axes),
            lambda letter: displacements(springs, letter, parity.axes),
        )
    )
    times = springs.log.times
    basis = "damping D of the controller looks like a lag of -D / K"
    return _lag(
        springs,
        name,
        motion,
        wrench,
        lambda shift: _at(times - shift, times, away),
        basis,
        centre=True,
    )


def _sparse(springs: Springs) -> str:
    if springs.sparse:
        return "rows were read one by one, at rest"
    if len(springs.log) < 100:
        return f"there are {len(springs.log)} samples only"
    return ""


def _at(
    when: Float[np.ndarray, " k"], times: Float[np.ndarray, " n"], values: Float[np.ndarray, "n c"]
) -> Float[np.ndarray, "k c"]:
    return np.stack([np.interp(when, times, column) for column in values.T], axis=1)


def _edges(response: np.ndarray, causes: list[np.ndarray]) -> np.ndarray:
    """Blocks that are long beside what is left at the best of some shifts shares."""
    left, best = response, np.inf
    for cause in causes:
        slope = (response * cause).sum(0) / np.maximum((cause**2).sum(0), 1e-300)
        rest = response - slope * cause
        if (rest**2).sum() < best:
            left, best = rest * cause, (rest**2).sum()
    return block_edges(len(left), max(correlation_time(column) for column in left.T))


def _lag(springs, name, motion, response, cause, basis, centre) -> Quantity:
    # Whole samples: between them interpolation averages noise, which would look like a better fit.
    stride = -(-round(LONGEST / springs.step) // FINEST) * springs.step
    count = max(2, round(LONGEST / stride))
    shifts = stride * np.arange(-count, count + 1)
    edges = _edges(response, [cause(shift) for shift in shifts[:: max(1, count // 8)]])
    sizes = np.diff(np.append(edges, len(response)))[:, None]
    sums = []
    for shift in shifts:
        other = cause(shift)
        products = (response**2, response * other, other**2)
        parts = [np.add.reduceat(part, edges, axis=0) for part in products]
        if centre:
            means = [np.add.reduceat(part, edges, axis=0) / sizes for part in (response, other)]
            for part, (i, j) in zip(parts, ((0, 0), (0, 1), (1, 1)), strict=True):
                part -= sizes * means[i] * means[j]
        sums.append(np.stack(parts, axis=1))
    stacked = np.stack(sums, axis=1)

    def left(total: np.ndarray) -> Float[np.ndarray, " s"]:
        own, both, other = total[:, 0], total[:, 1], total[:, 2]
        scale = np.maximum(own.mean(0), 1e-300)
        return ((own - both**2 / np.maximum(other, 1e-300)) / scale).mean(1)

    def best(total: np.ndarray) -> np.ndarray:
        rest = left(total)
        k = int(np.clip(rest.argmin(), 1, len(rest) - 2))
        bend = rest[k - 1] - 2 * rest[k] + rest[k + 1]
        part = 0.5 * (rest[k - 1] - rest[k + 1]) / bend if bend > 0 else 0.0
        return np.array(shifts[k] + np.clip(part, -1, 1) * (shifts[1] - shifts[0]))

    rest = left(stacked.sum(0))
    explained = 1.0 - float(rest.min())
    if explained < EXPLAINED:
        reason = f"the best shift explains {explained:.0%} of what moves"
        return Quantity(name, "s", reason=reason, motion=motion)
    if rest.argmin() in (0, len(rest) - 1):
        reason = f"no shift within {LONGEST:g} s fits best"
        return Quantity(name, "s", reason=reason, motion=motion)
    found = jackknife(best, stacked)
    low, high = (float(v) for v in found.bounds())
    least = RESOLVED * stride
    low, high = min(low, float(found.value) - least), max(high, float(found.value) + least)
    told = f"explains {explained:.0%}; delay, time constant and difference of clocks together"
    basis = f"{told}; {basis}" if basis else told
    return Quantity(name, "s", float(found.value), (low, high), basis=basis)
