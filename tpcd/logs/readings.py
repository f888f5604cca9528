"""Which reading of a recording fits K (x - u) at rest, and which others fit better or alike.

`hypotheses` scores them; here is which of them are told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tpcd.logs.conventions import AtRest, RotationReading, changes_of
from tpcd.logs.hypotheses import MISSED, TOLERANCE, Judge, Reading
from tpcd.logs.log import Log
from tpcd.logs.plane import Plane, WrenchReading
from tpcd.logs.remains import Remains
from tpcd.logs.settled import Settled

CLEARER = 0.5
"""A channel is read better where so little of what was left of it is left."""
DECISIVE = 10.0
"""Log likelihood by which another reading must be better to be named."""
TIED = 6.0
"""Readings within this of the best one are named with it."""


@dataclass(frozen=True)
class Readings:
    """The reading that was chosen, and those that fit better or alike."""

    own: Reading
    better: tuple[Reading, ...]
    """The best others, where they are much better; more than one where they fit alike."""
    alike: tuple[Reading, ...]
    """Others of one change that fit as well as the own one and make another episode."""
    remains: Remains
    """What w - K (x - u) is, as it was read."""
    turned: float
    """Rotation of the settled samples since the first one, root mean square [rad]."""

    @property
    def in_plane_otherwise(self) -> bool:
        """Whether what fits better has the rotation in the plane."""
        return any(each.left.get("rotation", 0.0) <= MISSED for each in self.better[:1])

    @property
    def exchanged(self) -> bool:
        """Whether what fits better reads other numbers, and not only another point or size."""
        subjects = {change.subject for each in self.better[:1] for change in each.changes}
        return bool(subjects - {"point", "factor"})


def at_rest(log: Log, settled: Settled) -> Log:
    """One sample for each settled stretch: means, and the rotation nearest to the mean one."""
    whole = [np.arange(first, end) for first, end in settled.stretches]
    chosen = np.array([part[_middle(log.rotations[part])] for part in whole], dtype=np.int64)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([values[part].mean(0) for part in whole])

    target = log.command_positions
    return replace(
        log.only(_mask(chosen, len(log))),
        positions=mean(log.positions),
        forces=mean(log.forces),
        torques=mean(log.torques),
        command_positions=None if target is None else mean(target),
        findings=(),
    )


def compare(
    log: Log,
    plane: Plane,
    wrench: WrenchReading,
    rotation: RotationReading,
    settled: Settled,
    stiffness: Float[np.ndarray, " 3"],
) -> Readings | None:
    """Test the conventions of a recording with commands together; None where nothing is felt and
    nothing turns, or fewer than two rows are settled."""
    if settled.commands is None or len(settled.rows) < 2:
        return None
    start = at_rest(log, settled)
    # The first row is free: what the sensor reads there is its zero.
    zeroed = replace(
        start, forces=start.forces - start.forces[0], torques=start.torques - start.torques[0]
    )
    rest = AtRest(zeroed, replace(wrench, offset=(0.0,) * 6), stiffness, np.ones(2))
    judge = Judge(replace(plane, tool_x=None), rest, settled.noise)
    found = judge.all_of(changes_of(log, wrench, rotation))
    if not found:
        return None
    own = found[0]
    # What makes all forces vanish explains nothing.
    found = [reading for reading in found if set(own.left) <= set(reading.left)]
    fitting = [reading for reading in found if reading.fits]
    best = max(fitting, key=lambda reading: reading.score, default=own)
    better: list[Reading] = []
    if best.changes and _much_better(best, own):
        near = [r for r in fitting if r.score > best.score - TIED and r.changes]
        fewest = min(len(reading.changes) for reading in near)
        better = sorted((r for r in near if len(r.changes) == fewest), key=lambda r: -r.score)
    alike = [
        r
        for r in found
        if own.fits
        and not better
        and [change.subject for change in r.changes] not in ([], ["point"], ["factor"])
        and len(r.changes) == 1
        and abs(r.likelihood - own.likelihood) < 1.0
        and not same_episode(r, own)
    ]
    return Readings(own, tuple(better), tuple(alike), judge.remains(own), judge.turned)


def same_episode(first: Reading, second: Reading) -> bool:
    """Whether two readings make one episode, but for where angles are zero."""
    if (np.abs(np.log(first.stiffness / second.stiffness)) > TOLERANCE).any():
        return False
    parts = []
    for reading in (first, second):
        rows = reading.rows.copy()
        rows[:, [2, 5]] -= rows[:1, [2]]
        rows[:, [2, 5]] = np.remainder(rows[:, [2, 5]] + math.pi, 2 * math.pi) - math.pi
        parts.append(rows)
    size = np.abs(parts[0]).max(0) + np.array([1e-3, 1e-3, 0.01] * 2 + [0.3, 0.3, 0.02])
    return bool((np.abs(parts[0] - parts[1]).max(0) < TOLERANCE * size).all())


def _much_better(best: Reading, own: Reading) -> bool:
    """Whether another reading fits, and what is left of some channel is much less."""
    if not best.fits or best.score - own.score < DECISIVE:
        return False
    return any(
        best.left.get(name, 0.0) < CLEARER * left and left > 2 * TOLERANCE
        for name, left in own.left.items()
    )


def _middle(rotations: Rotation) -> int:
    """The one nearest to the mean."""
    return int(np.argmin((rotations.mean().inv() * rotations).magnitude()))


def _mask(chosen: Int[np.ndarray, " k"], count: int) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[chosen] = True
    return mask
