"""Rows of an episode whose sensor was frozen or at the end of its range when they were measured.

In equilibrium the wrench is K (pose - command), so a reading that is the same to the last digit in
rows for which that differs far beyond the noise was not measured in all of them. Rows without
noise, as simulated ones, repeat a reading only where K (pose - command) repeats as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from tpcd.planar import spring_wrench
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.habit import resolution

POSES = ("x", "z", "phi")
WRENCHES = ("F_x", "F_z", "tau")
UNITS = ("N", "N", "N·m")
BEYOND = 6.0
"""K (pose - command) differs where it does by this many standard deviations,"""
LEAST = (0.05, 0.05, 0.005)
"""and by so much on top of that: printed digits, in rows without noise [N, N, N·m]."""
FEWEST = 3
"""Rows with one reading of a single channel; of the whole wrench two will do."""
NOTABLE = 0.5
"""A wrench of nothing but zeros is what a model without noise reads in free space, so of it
K (pose - command) has to differ by this part of the largest."""


def check_repeats(
    commands: Float[np.ndarray, "n 3"],
    poses: Float[np.ndarray, "n 3"],
    wrenches: Float[np.ndarray, "n 3"],
    stiffness: Float[np.ndarray, " 3"],
    sensor_std: Float[np.ndarray, " 6"],
) -> tuple[Finding, ...]:
    """Rows whose pose or wrench is a repeated number, and no measurement.

    `commands` and `poses` (x, z, phi) [m, m, rad], `wrenches` (F_x, F_z, tau) [N, N, N·m],
    `stiffness` [N/m, N/m, N·m/rad], `sensor_std` of x, z, phi, F_x, F_z, tau. Angles as far apart
    as a turn count as near.
    """
    expected = spring_wrench(poses, commands, stiffness)
    noise = BEYOND * np.hypot(sensor_std[3:], stiffness * sensor_std[:3]) + LEAST
    found: list[Finding] = []
    told = np.zeros(len(wrenches), dtype=bool)
    for first, end in _runs((wrenches[1:] == wrenches[:-1]).all(1)):
        changes = np.ptp(expected[first:end], axis=0)
        allowed = noise
        if not wrenches[first].any():
            allowed = np.maximum(noise, NOTABLE * np.abs(expected).max(0))
        if (changes > allowed).any() and not _free(wrenches, first, end):
            axis = int(np.argmax(changes / allowed))
            told[first:end] = True
            found.append(_frozen(WRENCHES, wrenches[first], first, end, changes[axis], axis))
    for first, end in _runs((poses[1:] == poses[:-1]).all(1)):
        moved = np.ptp(commands[first:end], axis=0)
        left = np.abs(wrenches[first:end] - expected[first:end]).max(0)
        if end - first >= FEWEST and moved.any() and (left > noise).any():
            axis = int(np.argmax(left / noise))
            found.append(_frozen(POSES, poses[first], first, end, left[axis], axis))
    for axis in range(3):
        column, step = wrenches[:, axis], resolution(wrenches[:, axis])
        limit = noise[axis] + step
        ends = _at_end(column, expected[:, axis], noise[axis] - LEAST[axis], LEAST[axis] + step)
        found += [_clipped(axis, value, rows) for value, rows in ends]
        for first, end in _runs(column[1:] == column[:-1]):
            change = float(np.ptp(expected[first:end, axis]))
            at_end = any(column[first] == value for value, _ in ends)
            known = told[first:end].all() or _free(column[:, None], first, end)
            if end - first >= FEWEST and change > limit and not at_end and not known:
                names = (WRENCHES[axis],)
                found.append(_frozen(names, column[first : first + 1], first, end, change, axis))
    return tuple(found)


def _runs(same: Bool[np.ndarray, " m"]) -> Iterator[tuple[int, int]]:
    """First row, and the one after the last, of rows that each are the same as the row before."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], same.astype(np.int8), [0]))))
    for first, end in edges.reshape(-1, 2):
        yield int(first), int(end) + 1


def _free(readings: Float[np.ndarray, "n w"], first: int, end: int) -> bool:
    """Whether rows with one reading are rather those in free space of a sensor without noise.

    Such a reading comes again elsewhere, and it is that of the free start, unless the sensor read
    nothing else in most of the rows. A frozen sensor gives a number that it gave never before.
    """
    same = (readings == readings[first]).all(1)
    if 2 * (end - first) > len(readings):
        return False
    return first == 0 or int(same.sum()) > end - first


def _at_end(
    column: Float[np.ndarray, " n"], expected: Float[np.ndarray, " n"], noise: float, least: float
) -> list[tuple[float, Int[np.ndarray, " k"]]]:
    """Largest and smallest readings that several rows have although they should be beyond it, in
    the mean by more than their noise."""
    found = []
    for sign in (1.0, -1.0):
        top = float((sign * column).max())
        rows = np.flatnonzero(sign * column == top)
        short = sign * expected[rows].mean() - top
        if top > 0 and len(rows) >= FEWEST and short > noise / np.sqrt(len(rows)) + least:
            found.append((sign * top, rows))
    return found


def _frozen(
    names: Sequence[str],
    values: Float[np.ndarray, " k"],
    first: int,
    end: int,
    change: float,
    axis: int,
) -> Finding:
    shown = ", ".join(f"{value:.6g}" for value in values)
    if tuple(names) == POSES:
        why = f"the command changes and {WRENCHES[axis]} is up to {change:.2g} {UNITS[axis]} off"
    else:
        why = f"K (pose - command) changes by {change:.2g} {UNITS[axis]}"
    sentence = (
        f"rows {first} to {end - 1}: {', '.join(names)} exactly {shown} in all of them, while"
        f" {why}: the sensor was frozen"
    )
    remedy = "measure these rows again, or split the episode there"
    return Finding("frozen", Weight.DOUBT, sentence, tuple(names), rows=(first, end), remedy=remedy)


def _clipped(axis: int, value: float, rows: Int[np.ndarray, " k"]) -> Finding:
    listed = ", ".join(str(row) for row in rows[:8]) + (", …" if len(rows) > 8 else "")
    sentence = (
        f"rows {listed}: {WRENCHES[axis]} exactly {value:.6g} {UNITS[axis]} in {len(rows)} rows,"
        " and K (pose - command) beyond it: the sensor is at the end of its range"
    )
    remedy = "press less, or use a sensor with a larger range"
    span = (int(rows[0]), int(rows[-1]) + 1)
    return Finding("clipped", Weight.DOUBT, sentence, (WRENCHES[axis],), rows=span, remedy=remedy)
