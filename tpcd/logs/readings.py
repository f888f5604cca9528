"""Which reading of a recording fits K (x - u) at rest: conventions tested together.

A hypothesis is up to three changes of convention. Forces and torque of the settled rows, whose
scale of error is unknown, are held against K (x - u) with it profiled out,

    log L = -k/2 sum_c log((mean residual_c^2 + floor_c^2) / scale_c^2) + log prior,

where the floor is what is not worth telling apart, and the scale is the factor of a hypothesis on
units. Rotation out of the plane counts as one more channel, of few independent values, and forces
that would act from within the object (`lever`) count against a hypothesis: angles and torques that
are measured backwards fit K (x - u) alike, and little else at rest tells which. What fits alike is
named together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from tpcd.logs.conventions import AtRest, Change, RotationReading, changes_of, torque_about
from tpcd.logs.log import Log, LogError
from tpcd.logs.plane import Plane, WrenchReading, project
from tpcd.logs.settled import Settled
from tpcd.quality.lever import depth_of_contact

MOST_CHANGES = 3
TOLERANCE = 0.02
"""Residuals below this part of the readings are arms and sensors as they are, not conventions."""
LEAST_TURN = 0.02
"""Swings out of the plane below this [rad] are how a tool is mounted."""
SWINGS = 5
"""Independent values that the swing of a whole motion counts for."""
MISSED = 0.5
"""A reading that leaves this part of a channel or less fits it."""
CLEARER = 0.5
"""A channel is read better where so little of what was left of it is left."""
DECISIVE = 10.0
"""Log likelihood by which another reading must be better to be named."""
TIED = 6.0
"""Readings within this of the best one are named with it."""
FELT = 1.0
"""Forces K (x - u) below this show nothing about the wrench [N]."""
FARTHEST_POINT = 1.0
"""Torques are taken about no point farther from the end effector [m]."""
BEYOND_NOISE = 3.0
WITHIN = -5.0
"""Depth of contact in standard errors from which forces act from within the object."""
RARELY_WITHIN = 5.5
"""Log of how rarely that is found of a right reading: in 1 of 252 recordings of objects of every
kind, by three motions."""


@dataclass(frozen=True, eq=False)
class Reading:
    """What is left under one hypothesis."""

    changes: tuple[Change, ...]
    rows: Float[np.ndarray, "k 9"]
    """Planar pose, command and wrench of the settled samples."""
    left: dict[str, float]
    """Part of force, torque and rotation that is left, of those that show anything."""
    likelihood: float
    depth: float
    """How far before the hand forces act, in its standard errors; negative from within."""

    @property
    def score(self) -> float:
        """Log posterior, but for a constant."""
        return self.likelihood - sum(change.cost for change in self.changes)

    @property
    def fits(self) -> bool:
        """Whether forces and torque that are felt are K (x - u)."""
        return all(self.left.get(name, 0.0) <= MISSED for name in ("force", "torque"))

    @property
    def said(self) -> str:
        """The conventions, as clauses."""
        return " and ".join(change.said for change in self.changes) or "as it was read"

    @property
    def remedy(self) -> str:
        """The options."""
        return " ".join(change.remedy for change in self.changes)


@dataclass(frozen=True)
class Readings:
    """The reading that was chosen, and those that fit better or alike."""

    own: Reading
    better: tuple[Reading, ...]
    """The best others, where they are much better; more than one where they fit alike."""
    alike: tuple[Reading, ...]
    """Others of one change that fit as well as the own one and make another episode."""
    gain: Float[np.ndarray, " 3"]
    """How many times K (x - u) each channel is, as it was read."""
    turned: float
    """Rotation of the settled samples since the first one, root mean square [rad]."""


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
    judge = _Judge(replace(plane, tool_x=None), rest, settled.noise)
    own = judge.reading(())
    if own is None:
        return None
    changes = changes_of(log, wrench, rotation)
    found = [own, *judge.all_of(changes)]
    tried = [own, *(reading for reading in _best(found, 4) if reading.changes)]
    found += [each for r in tried if (each := judge.about_point(r)) is not None]
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
        and [change.subject for change in r.changes] not in ([], ["point"])
        and len(r.changes) == 1
        and abs(r.likelihood - own.likelihood) < 1.0
        and not same_episode(r, own)
    ]
    return Readings(own, tuple(better), tuple(alike), judge.gain(own), judge.turned)


def same_episode(first: Reading, second: Reading) -> bool:
    """Whether two readings make one episode, but for where angles are zero."""
    parts = []
    for reading in (first, second):
        rows = reading.rows.copy()
        rows[:, [2, 5]] -= rows[:1, [2]]
        rows[:, [2, 5]] = np.remainder(rows[:, [2, 5]] + math.pi, 2 * math.pi) - math.pi
        parts.append(rows)
    size = np.abs(parts[0]).max(0) + np.array([1e-3, 1e-3, 0.01] * 2 + [0.3, 0.3, 0.02])
    return bool((np.abs(parts[0] - parts[1]).max(0) < TOLERANCE * size).all())


class _Judge:
    """Scores hypotheses about one recording at rest on one scale."""

    def __init__(self, plane: Plane, rest: AtRest, noise: Float[np.ndarray, " 6"]) -> None:
        self.plane, self.rest, self.noise = plane, rest, noise
        force, torque = _size(rest.log.forces), _size(rest.log.torques)
        sizes = TOLERANCE * np.array([force, force, torque])
        self.floor = np.hypot(noise[3:], sizes) + 1e-6
        self.turned = _turned(rest.log.rotations)

    def all_of(self, changes: Sequence[Change]) -> list[Reading]:
        """Every hypothesis of one to `MOST_CHANGES` changes that can be made; of two at most where
        one is of the many ways in which axes may be named."""
        found = []
        for count in range(1, MOST_CHANGES + 1):
            for some in combinations(changes, count):
                subjects = {change.subject for change in some}
                if len(subjects) == count and (count < 3 or "axes" not in subjects):
                    found.append(self.reading(some))
        return [reading for reading in found if reading is not None]

    def reading(self, changes: tuple[Change, ...]) -> Reading | None:
        """What is left under some changes; None where the recording does not allow them."""
        rest = self.rest
        for change in changes:
            rest = change.apply(rest)
        try:
            planar = project(rest.log, self.plane, rest.wrench)
        except LogError:
            return None
        assert planar.commands is not None
        expected = _spring(planar.poses, planar.commands, rest.stiffness)
        rows = np.column_stack((planar.poses, planar.commands, planar.wrenches))
        wrong = planar.wrenches - expected
        scale = rest.scale[[0, 0, 1]]
        k = len(wrong)
        likelihood = -0.5 * k * np.log((wrong**2).mean(0) / scale**2 + self.floor**2).sum()
        swing, turned = planar.motion_left_out[:, 1], rest.log.rotations
        turn = _turned(turned)
        likelihood -= (
            0.5 * SWINGS * math.log(_size(swing) ** 2 + LEAST_TURN**2 + (TOLERANCE * turn) ** 2)
        )
        left = {}
        for name, part in (("force", slice(0, 2)), ("torque", slice(2, 3))):
            sizes = _size(expected[:, part]), _size(planar.wrenches[:, part])
            least = _size((rest.stiffness * self.noise[:3])[part][None])
            told = _size((scale * self.noise[3:])[part][None])
            if max(sizes) > (FELT if name == "force" else 0.0) and (
                sizes[0] > BEYOND_NOISE * least or sizes[1] > BEYOND_NOISE * told
            ):
                left[name] = _size(wrong[:, part]) / max(sizes)
        if turn > LEAST_TURN:
            left["rotation"] = _size(swing) / turn
        depth, error = depth_of_contact(
            planar.wrenches, planar.poses[:, 2], float(scale[2] * self.noise[5])
        )
        if depth < WITHIN * error:
            likelihood -= RARELY_WITHIN
        return Reading(changes, rows, left, float(likelihood), depth / error)

    def about_point(self, reading: Reading) -> Reading | None:
        """The reading with torques about the point that fits them best; None where they fit."""
        if reading.left.get("torque", 0.0) < 2 * TOLERANCE or len(reading.rows) < 6:
            return None
        rest = self.rest
        for change in reading.changes:
            rest = change.apply(rest)
        axis = self.plane.directions
        forces = reading.rows[:, 6:8] @ axis[:2]
        lever = rest.log.rotations.inv().apply(np.cross(forces, axis[2]))
        expected = _spring(reading.rows[:, :3], reading.rows[:, 3:6], rest.stiffness)[:, 2]
        moved, *_ = np.linalg.lstsq(lever, expected - reading.rows[:, 8], rcond=0.05)
        point = np.array(rest.wrench.point) + moved
        if np.linalg.norm(point) > FARTHEST_POINT:
            return None
        told = " ".join(f"{value:.3g}" for value in point)
        change = Change(
            "point",
            f"torques are taken about ({told.replace(' ', ', ')}) m of the end effector",
            f"--wrench_point {told}",
            5.0 + math.log(len(reading.rows)),
            lambda rest: torque_about(rest, point),
        )
        return self.reading((*reading.changes, change))

    def gain(self, reading: Reading) -> Float[np.ndarray, " 3"]:
        """How many times K (x - u) each channel of the wrench is; NaN where that is all zero."""
        rows = reading.rows
        expected = _spring(rows[:, :3], rows[:, 3:6], self.rest.stiffness)
        with np.errstate(invalid="ignore", divide="ignore"):
            return (rows[:, 6:] * expected).sum(0) / (expected**2).sum(0)


def _much_better(best: Reading, own: Reading) -> bool:
    """Whether another reading fits, and what is left of some channel is much less."""
    if not best.fits or best.score - own.score < DECISIVE:
        return False
    return any(
        best.left.get(name, 0.0) < CLEARER * left and left > 2 * TOLERANCE
        for name, left in own.left.items()
    )


def _best(found: Sequence[Reading], count: int) -> list[Reading]:
    return sorted(found, key=lambda reading: -reading.score)[:count]


def _turned(rotations: Rotation) -> float:
    """Root mean square angle since the first one [rad]."""
    return _size((rotations * rotations[0].inv()).magnitude())


def _spring(
    poses: Float[np.ndarray, "k 3"],
    commands: Float[np.ndarray, "k 3"],
    stiffness: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "k 3"]:
    away = poses - commands
    away[:, 2] = np.remainder(away[:, 2] + math.pi, 2 * math.pi) - math.pi
    return stiffness * away


def _size(values: np.ndarray) -> float:
    """Root mean square length of rows."""
    return float(np.sqrt((np.reshape(values, (len(values), -1)) ** 2).sum(1).mean()))


def _middle(rotations: Rotation) -> int:
    """The one nearest to the mean."""
    return int(np.argmin((rotations.mean().inv() * rotations).magnitude()))


def _mask(chosen: Int[np.ndarray, " k"], count: int) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[chosen] = True
    return mask
