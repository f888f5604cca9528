"""Settled steps of a planar recording: where a command was held and the arm stood still.

A row is the mean over the last moments of a hold. Each such stretch is cut into four blocks; the
scatter of their means, halved, is the noise of the row (batch means: Law and Kelton, "Simulation
Modeling and Analysis", on the variance of a correlated series' mean), so noise that is correlated
for less than a block counts in full. What changes from one stretch to another, such as drift of the
sensor, does not show in it.

A stretch is whole: where a finding leaves out any of it, be it samples that are there or a time
in which none came, it makes no row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tpcd.data.noise import resolution
from tpcd.logs.plane import PlanarLog
from tpcd.quality.finding import overlapping

BLOCKS = 4
HELD = (1e-5, 1e-5, 1e-5)
"""A command that stays so close to where its hold began is held [m, m, rad]."""
RESTLESS = 0.02
"""Set points that keep to this part of all their motion for a window are meant to be held."""
SCATTER = 3.0
"""Drift beyond what is allowed counts from so many standard errors of it."""


@dataclass(frozen=True)
class Stillness:
    """When an arm counts as settled."""

    window: float = 0.5
    """Length of the stretch at the end of a hold that makes a row [s]."""
    drift: tuple[float, float, float, float] = (3e-4, 1e-3, 0.5, 0.05)
    """Largest change across it of x and z [m], phi [rad], F_x and F_z [N], tau [N·m]."""

    @property
    def channels(self) -> Float[np.ndarray, " 6"]:
        """The allowed drift of x, z, phi, F_x, F_z, tau."""
        length, angle, force, torque = self.drift
        return np.array([length, length, angle, force, force, torque])


@dataclass(frozen=True, eq=False)
class Settled:
    """k settled rows of a recording."""

    stretches: Int[np.ndarray, "k 2"]
    """First sample of each row's stretch, and the one after its last."""
    rows: Float[np.ndarray, "k 6"]
    """Mean x, z, phi [m, m, rad], F_x, F_z, tau [N, N, N·m]."""
    commands: Float[np.ndarray, "k 3"] | None
    """Held commands [m, m, rad]; None where they were not recorded."""
    noise: Float[np.ndarray, " 6"]
    """One standard deviation of a row."""
    unsettled: tuple[float, ...]
    """Times at which holds ended that were left out because the arm still moved [s]."""
    brief: int
    """Holds too short for a row, or with too few samples in it."""
    broken: tuple[float, ...] = ()
    """Times at which stretches ended that findings leave out, in whole or in part [s]."""
    off_median: Float[np.ndarray, "k 6"] | None = None
    """By how much the mean of a row lies further from the median of its samples than their noise,
    steps or drift take it, as spikes do; None where the arm may have moved."""


def find_settled(log: PlanarLog, stillness: Stillness) -> Settled:
    """The settled rows of a recording; none where no command was held long enough.

    Without commands, steps cannot be told apart: then the rows are the whole recording, cut into
    stretches of the window's length.
    """
    if log.commands is None:
        stretches = _windows(log.times, stillness.window)
        ends = log.times[stretches[:, 1] - 1]
        whole = np.array([_whole(log, float(end), stillness) for end in ends], dtype=bool)
        return _rows(log, stretches[whole], None, (), 0, tuple(ends[~whole].tolist()))
    holds = find_holds(log.commands)
    ends = log.times[holds[:, 1] - 1]
    long = ends - log.times[holds[:, 0]] >= stillness.window
    brief = int(((ends - log.times[holds[:, 0]] >= stillness.window / 5) & ~long).sum())
    stretches, unsettled, broken = [], [], []
    for (_, end), time in zip(holds[long], ends[long], strict=True):
        first = int(np.searchsorted(log.times, time - stillness.window))
        if not _whole(log, float(time), stillness):
            broken.append(float(time))
        elif end - first < 2 * BLOCKS:
            brief += 1
        elif _still(log, first, int(end), stillness):
            stretches.append((first, int(end)))
        else:
            unsettled.append(float(time))
    found = np.array(stretches, dtype=np.int64).reshape(-1, 2)
    return _rows(log, found, log.commands, tuple(unsettled), brief, tuple(broken))


def find_holds(commands: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "h 2"]:
    """First sample of every hold, and the one after its last; a ramp is many short ones."""
    holds, begun = [], 0
    rows = commands.tolist()
    for k, row in enumerate(rows):
        start = rows[begun]
        if any(abs(a - b) > held for a, b, held in zip(row, start, HELD, strict=True)):
            holds.append((begun, k))
            begun = k
    holds.append((begun, len(rows)))
    return np.array(holds, dtype=np.int64)


def restless_commands(
    times: Float[np.ndarray, " n"], commands: Float[np.ndarray, "n 3"] | None, window: float
) -> str:
    """How far set points go in the quietest tenth of windows, where they are meant to be held but
    never are: they scatter, or creep to where they were sent; "" where they are, or move on."""
    windows = [] if commands is None else _windows(times, window)
    if commands is None or not len(windows):
        return ""
    spans = np.stack([np.ptp(commands[first:end], axis=0) for first, end in windows])
    parts = spans / np.maximum(np.ptp(commands, axis=0), 1e-9)
    quiet = spans[np.argsort(parts.max(1))[len(spans) // 10]]
    if (quiet <= HELD).all() or (quiet > RESTLESS * np.ptp(commands, axis=0) + HELD).any():
        return ""
    length, angle = 1e3 * float(quiet[:2].max()), float(np.degrees(quiet[2]))
    return (
        f"set points are nowhere held, and go {length:.2g} mm and {angle:.2g} degrees in"
        f" {window:g} s where they are quietest"
    )


def _windows(times: Float[np.ndarray, " n"], window: float) -> Int[np.ndarray, "k 2"]:
    edges = np.searchsorted(times, np.arange(times[0], times[-1], window))
    pairs = np.stack((edges, np.append(edges[1:], len(times))), axis=1)
    return pairs[pairs[:, 1] - pairs[:, 0] >= 2 * BLOCKS].astype(np.int64)


def _whole(log: PlanarLog, end: float, stillness: Stillness) -> bool:
    """Whether no finding leaves out any of the window that ends at some time."""
    return not overlapping(end - stillness.window, end, log.findings)


def _still(log: PlanarLog, first: int, end: int, stillness: Stillness) -> bool:
    values = np.column_stack((log.poses[first:end], log.wrenches[first:end]))
    half = len(values) // 2
    early, late = values[:half], values[half:]
    error = np.hypot(early.std(0) / np.sqrt(len(early)), late.std(0) / np.sqrt(len(late)))
    # The means of the halves are half of the stretch apart.
    drift = 2.0 * np.abs(late.mean(0) - early.mean(0))
    return bool((drift <= stillness.channels + 2.0 * SCATTER * error).all())


def _rows(
    log: PlanarLog,
    stretches: Int[np.ndarray, "k 2"],
    commands: Float[np.ndarray, "n 3"] | None,
    unsettled: tuple[float, ...],
    brief: int,
    broken: tuple[float, ...] = (),
) -> Settled:
    values = np.column_stack((log.poses, log.wrenches))
    rows, squares, scatter, off = (np.zeros((len(stretches), 6)) for _ in range(4))
    for k, (first, end) in enumerate(stretches):
        part = values[first:end]
        rows[k], scatter[k] = part.mean(0), part.var(0)
        median = np.median(part, axis=0)
        off[k] = np.abs(rows[k] - median) - np.median(np.abs(part - median), axis=0)
        means = np.stack([block.mean(0) for block in np.array_split(part, BLOCKS)])
        squares[k] = means.var(0, ddof=1) / BLOCKS
    held = None
    if commands is not None:
        held = np.stack([commands[end - 1] for _, end in stretches]) if len(stretches) else rows
        held = held[:, :3]
    if not len(rows):
        return Settled(stretches, rows, held, np.full(6, np.nan), unsettled, brief, broken)
    steps = np.array([resolution(column) for column in values.T])
    noise = np.maximum(np.sqrt(squares.mean(0)), _rounding(steps, scatter.mean(0)))
    off = None if held is None else np.where(off > steps, off, 0.0)
    return Settled(stretches, rows, held, noise, unsettled, brief, broken, off)


def _rounding(
    steps: Float[np.ndarray, " 6"], variance: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, " 6"]:
    """What rounding to steps leaves in the mean of many samples that have some variance.

    Noise carries samples over several steps, and so their mean to between the steps (dither;
    Gray and Stockham, "Dithered quantizers", IEEE Transactions on Information Theory 39, 1993).
    """
    noise = np.maximum(variance - steps**2 / 12.0, 0.0)
    across = np.divide(noise, steps**2, out=np.zeros_like(noise), where=steps > 0)
    return steps / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * across)
