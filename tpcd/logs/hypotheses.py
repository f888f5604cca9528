"""Hypotheses on a recording at rest, scored on one scale: conventions tested together.

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
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tpcd.logs.conventions import AtRest, Change, factor_of_stiffness, torque_about
from tpcd.logs.log import Log, LogError
from tpcd.logs.plane import Motion, Plane, motion_in_plane, project
from tpcd.logs.remains import Remains, remains
from tpcd.planar import spring_wrench
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
FELT = 1.0
"""Forces K (x - u) below this show nothing about the wrench [N]."""
FARTHEST_POINT = 1.0
"""Torques are taken about no point farther from the end effector [m]."""
BEYOND_NOISE = 3.0
GOOD = 0.1
"""Factors of the stiffness nearer to 1 (in logarithms) are those of arms and sensors as they are:
only their product shows."""
SPREAD = 0.7
"""One standard deviation of the logarithm of a factor that was mistaken,"""
LARGEST = 30.0
"""and the largest one: what is larger is a unit."""
COST = 3.0
"""Minus the logarithm of the prior odds that some stiffness was stated wrongly."""
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
    stiffness: Float[np.ndarray, " 3"]
    """[N/m, N/m, N·m/rad]"""
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


class Judge:
    """Scores hypotheses about one recording at rest on one scale."""

    def __init__(self, plane: Plane, rest: AtRest, noise: Float[np.ndarray, " 6"]) -> None:
        self.plane, self.rest, self.noise = plane, rest, noise
        force, torque = _size(rest.log.forces), _size(rest.log.torques)
        sizes = TOLERANCE * np.array([force, force, torque])
        self.floor = np.hypot(noise[3:], sizes) + 1e-6
        self.turned = _turned(rest.log.rotations)
        self._turned: tuple[Log, Motion, float] | None = None
        """The last recording, its motion in the plane, and how far it turned."""

    def all_of(self, changes: Sequence[Change]) -> list[Reading]:
        """Hypotheses of ever more changes, `MOST_CHANGES` at most, until one leaves no more than
        arms and sensors as they are do: what is simpler is said first.

        Axes may be named in so many ways that they are changed with one more thing at most. Each
        is held against the springs with factors of the stiffness too, and the best ones with
        torques about another point.
        """
        found = self.readings((), self.rest)
        if not found:
            return []
        moved: list[Reading] = []
        begun: list[tuple[tuple[Change, ...], AtRest, int]] = [((), self.rest, 0)]
        for count in range(1, MOST_CHANGES + 1):
            level, begun = begun, []
            for some, rest, first in level:
                for k, change in enumerate(changes[first:], first + 1):
                    both = (*some, change)
                    subjects = {each.subject for each in both}
                    if len(subjects) == count and (count < 3 or "axes" not in subjects):
                        made = change.apply(rest)
                        found += self.readings(both, made)
                        begun.append((both, made, k))
            tried = [found[0], *(reading for reading in _best(found, 4) if reading.changes)]
            moved = [each for reading in tried for each in self.about_point(reading)]
            best = _best([*found, *moved], 1)[0]
            if max(best.left.values(), default=0.0) <= 2 * TOLERANCE:
                break
        return found + moved

    def readings(self, changes: tuple[Change, ...], rest: AtRest) -> list[Reading]:
        """What is left under changes that made `rest`, and with factors of the stiffness too; none
        where the recording does not allow them."""
        try:
            planar = project(rest.log, self.plane, rest.wrench, self._motion(rest.log)[0])
        except LogError:
            return []
        assert planar.commands is not None
        rows = np.column_stack((planar.poses, planar.commands, planar.wrenches))
        found = [self._scored(changes, rest, rows, planar.motion_left_out[:, 1])]
        if len(changes) < MOST_CHANGES and not any(each.of_stiffness for each in changes):
            fitted = self._factors(rest, rows)
            if fitted is not None:
                change = factor_of_stiffness(rest.stiffness, *fitted)
                made = change.apply(rest)
                swing = planar.motion_left_out[:, 1]
                found.append(self._scored((*changes, change), made, rows, swing))
        return found

    def _motion(self, log: Log) -> tuple[Motion, float]:
        """Motion in the plane, which is the same in most hypotheses that are made in a row."""
        last = self._turned
        if (
            last is None
            or last[0].positions is not log.positions
            or last[0].command_positions is not log.command_positions
            or last[0].rotations is not log.rotations
            or last[0].command_rotations is not log.command_rotations
        ):
            last = self._turned = (log, motion_in_plane(log, self.plane), _turned(log.rotations))
        return last[1:]

    def _scored(
        self,
        changes: tuple[Change, ...],
        rest: AtRest,
        rows: Float[np.ndarray, "k 9"],
        swing: Float[np.ndarray, " k"],
    ) -> Reading:
        expected = spring_wrench(rows[:, :3], rows[:, 3:6], rest.stiffness)
        wrenches, turn = rows[:, 6:], self._motion(rest.log)[1]
        squares = ((wrenches - expected) ** 2).mean(0)
        told, springs = (wrenches**2).mean(0), (expected**2).mean(0)
        scale = rest.scale[[0, 0, 1]]
        likelihood = -0.5 * len(rows) * np.log(squares / scale**2 + self.floor**2).sum()
        swung = float((swing**2).mean())
        likelihood -= 0.5 * SWINGS * math.log(swung + LEAST_TURN**2 + (TOLERANCE * turn) ** 2)
        left = {}
        least, noise = (rest.stiffness * self.noise[:3]) ** 2, (scale * self.noise[3:]) ** 2
        for name, part in (("force", slice(0, 2)), ("torque", slice(2, 3))):
            sizes = np.sqrt([springs[part].sum(), told[part].sum()])
            floors = BEYOND_NOISE * np.sqrt([least[part].sum(), noise[part].sum()])
            if sizes.max() > (FELT if name == "force" else 0.0) and (sizes > floors).any():
                left[name] = float(np.sqrt(squares[part].sum()) / sizes.max())
        if turn > LEAST_TURN:
            left["rotation"] = math.sqrt(swung) / turn
        depth, error = depth_of_contact(wrenches, rows[:, 2], float(scale[1] * self.noise[5]))
        if depth < WITHIN * error:
            likelihood -= RARELY_WITHIN
        return Reading(changes, rows, rest.stiffness, left, float(likelihood), depth / error)

    def _factors(
        self, rest: AtRest, rows: Float[np.ndarray, "k 9"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], float] | None:
        """The factors of the stiffness that fit the rows best, their standard errors, and what
        they cost; None where it is as stated."""
        expected = spring_wrench(rows[:, :3], rows[:, 3:6], rest.stiffness)
        scale, count = rest.scale[[0, 0, 1]], len(rows)
        size = np.sqrt((expected**2).mean(0))
        felt = size > BEYOND_NOISE * np.maximum(
            rest.stiffness * self.noise[:3], scale * self.noise[3:]
        )
        factor, error = remains(rows, expected, scale * self.floor).factor
        with np.errstate(invalid="ignore", divide="ignore"):
            away = np.abs(np.log(factor))
            gain = 0.5 * count * np.log1p((factor - 1.0) ** 2 / error**2 / count)
            own = 0.5 * math.log(count) + 0.5 * (away / SPREAD) ** 2
            sure = (away > GOOD + 2.0 * error / factor) & (away < math.log(LARGEST))
            other = felt & sure & (gain > own)
        if not other.any():
            return None
        return np.where(other, factor, 1.0), error, COST + float(own[other].sum())

    def about_point(self, reading: Reading) -> list[Reading]:
        """The reading with torques about the point that fits them best; none where they fit."""
        if reading.left.get("torque", 0.0) < 2 * TOLERANCE or len(reading.rows) < 6:
            return []
        rest = self.rest
        for change in reading.changes:
            rest = change.apply(rest)
        axis = self.plane.directions
        forces = reading.rows[:, 6:8] @ axis[:2]
        lever = rest.log.rotations.inv().apply(np.cross(forces, axis[2]))
        expected = spring_wrench(reading.rows[:, :3], reading.rows[:, 3:6], rest.stiffness)[:, 2]
        moved, *_ = np.linalg.lstsq(lever, expected - reading.rows[:, 8], rcond=0.05)
        point = np.array(rest.wrench.point) + moved
        if np.linalg.norm(point) > FARTHEST_POINT:
            return []
        told = " ".join(f"{value:.3g}" for value in point)
        change = Change(
            "point",
            f"torques are taken about ({told.replace(' ', ', ')}) m of the end effector",
            f"--wrench_point {told}",
            5.0 + math.log(len(reading.rows)),
            lambda rest: torque_about(rest, point),
        )
        return self.readings((*reading.changes, change), change.apply(rest))

    def remains(self, reading: Reading) -> Remains:
        """What w - K (x - u) is, by cause."""
        expected = spring_wrench(reading.rows[:, :3], reading.rows[:, 3:6], reading.stiffness)
        return remains(reading.rows, expected, self.floor)


def _best(found: Sequence[Reading], count: int) -> list[Reading]:
    return sorted(found, key=lambda reading: -reading.score)[:count]


def _turned(rotations: Rotation) -> float:
    """Root mean square angle since the first one [rad]."""
    return _size((rotations * rotations[0].inv()).magnitude())


def _size(values: np.ndarray) -> float:
    """Root mean square length of rows."""
    return float(np.sqrt((np.reshape(values, (len(values), -1)) ** 2).sum(1).mean()))
