"""What the step is asked and where its answers go; planes, law and chains of a scene."""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.geometry.candidates import build_chains
from tpcd.geometry.query import meet, plane_of, spread
from tpcd.loops import inner
from tpcd.parameters import LARGEST_FRICTION
from tpcd.simulator.rest import PROBE_ANGLE
from tpcd.simulator.workspace import Law
from tpcd.terrain import OFF_UNIT


class Request(NamedTuple):
    """What is asked of b transitions: outline, planes, start pose, command before and command.

    `owner` and `place` (b) say whose points and whose planes of the `World` a transition has.
    `stiffness` is (b or 1, 3). `rested` says that nothing was commanded before, so that
    `previous` equals the start.
    """

    owner: np.ndarray
    place: np.ndarray
    stiffness: np.ndarray
    starts: np.ndarray
    previous: np.ndarray
    commands: np.ndarray
    rested: bool
    substeps: int
    finest: float
    largest_turn: float
    follow_path: bool


class Answer(NamedTuple):
    """Where the answers go; the fields of `Transition` but the wrench.

    `contacts` (b, t, 4) are normal and tangential force, and the arm of the contact point from
    the end effector in world axes. Derivatives by further inputs (see `Slopes.further`) are
    `from_inputs` (b, i, 3) and `from_points` (b, p, 2, 3), without entries where none are asked.
    """

    poses: np.ndarray
    modes: np.ndarray
    statuses: np.ndarray
    residuals: np.ndarray
    from_start: np.ndarray
    from_gap: np.ndarray
    from_lever: np.ndarray
    contacts: np.ndarray
    from_inputs: np.ndarray
    from_points: np.ndarray


@inner(_nrt=True)
@no_type_check
def new_planes(terrains):
    """Room for what one transition meets: where its surfaces are in their table, how much further
    away they are, friction and compliance."""
    flat = (1, terrains)
    return np.zeros(1, np.int64), np.zeros(flat), np.zeros(flat), np.zeros(flat)


@inner(_nrt=True)
@no_type_check
def own_law(law):
    """A copy of the law whose stiffness can be set for each transition."""
    return Law(np.ones(3), np.ones(3), law.coulomb, law.rounds, law.tolerance, law.room)


@inner
@no_type_check
def set_planes(here, world, place):
    """Take over the surfaces at a place of the world."""
    meet(here.surfaces, world.surfaces, here.where, place)
    for t in range(here.friction.shape[1]):
        here.friction[0, t] = world.friction[place, t]
        here.compliance[0, t] = world.compliance[place, t]


@inner(_nrt=True, error_model="numpy")
@no_type_check
def set_stiffness(law, stiffness):
    """Take over a stiffness (3) and its root."""
    for a in range(3):
        law.stiffness[a], law.root[a] = stiffness[a], math.sqrt(stiffness[a])


@inner
@no_type_check
def prepare(world, o, law, request, first, last, chains):
    """Chains of a scene for some transitions; returns how far its outline reaches [m]."""
    extent = _reach(world, o)
    if math.isfinite(extent):
        low, high = _angles(request, first, last)
        lean = 0.0 if law.coulomb else _largest(world.friction, o) * (high - low)
        build_chains(world, o, low, high, 2.0 * PROBE_ANGLE + lean, chains)
    return extent


@inner
@no_type_check
def _reach(world, o):
    """Distance of the furthest point from the end effector [m]; not finite for a bad outline."""
    largest, total = 0.0, 0.0
    for i in range(world.points.shape[2]):
        square = world.points[o, 0, i] ** 2 + world.points[o, 1, i] ** 2
        total += square
        largest = max(largest, square)
    # A NaN is no maximum, but it spoils the sum.
    return math.sqrt(largest) if math.isfinite(total) else np.nan


@inner
@no_type_check
def sound(world, o, law):
    """Whether planes and stiffness are finite, directions of length 1, friction within bounds and
    stiffness positive."""
    total, e, surfaces = 0.0, world.where[0], world.surfaces
    for t in range(world.friction.shape[1]):
        rough = world.friction[o, t]
        nx, nz, offset = plane_of(surfaces, e, t)
        total += abs(offset) + abs(world.clearance[o, t]) + spread(surfaces, e, t)
        total += 0.0 if 0.0 <= rough <= LARGEST_FRICTION else np.inf
        total += world.compliance[o, t] if world.compliance[o, t] >= 0.0 else np.inf
        square = nx**2 + nz**2
        total += 0.0 if abs(square - 1.0) <= OFF_UNIT else np.inf
    for a in range(3):
        total += law.root[a] if law.stiffness[a] > 0.0 else np.inf
    return math.isfinite(total)


@inner
@no_type_check
def _angles(request, first, last):
    """Least and largest object angle on the straight ways of some transitions [rad]."""
    low, high = np.inf, -np.inf
    for b in range(first, last):
        start = request.starts[b, 2]
        for angle in (
            start,
            start + wrap(request.previous[b, 2] - start),
            start + wrap(request.commands[b, 2] - start),
        ):
            if math.isfinite(angle):
                low, high = min(low, angle), max(high, angle)
    return (low, high) if low <= high else (0.0, 0.0)


@inner
@no_type_check
def _largest(values, o):
    largest = 0.0
    for t in range(values.shape[1]):
        largest = max(largest, abs(values[o, t]))
    return largest


@inner
@no_type_check
def wrap(angle):
    """The angle wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)
