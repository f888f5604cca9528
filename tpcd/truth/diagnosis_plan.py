"""The diagnosis motion fixed beforehand, for an arm that follows commands without feeling its way.

Where the hand stands when the object touches floor and wall is roughly known, so each pose is
foreseen: commands beyond a surface end on it, and along it friction holds the hand back. Every
command stays within `FORCE_LIMIT` of stiffness times the distance from the foreseen pose, even
where floor and wall are met early by the stated error. Ways that are too long for that are cut.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from tpcd.truth.contact_feel import USUAL_FRICTION, Command, Feel
from tpcd.truth.diagnosis_motion import (
    CLEARANCE,
    DOWN,
    LEFT,
    LIGHT,
    MEDIUM,
    NUDGES,
    PLACES,
    RIGHT,
    TILT,
    UP,
    Move,
    above,
    climb,
    corner,
    facing_wall,
    nudge,
    pause,
    peel,
    press,
    slide,
    tilt,
    wall_peel,
    wall_press,
    wall_slide,
    wall_tilt,
)
from tpcd.truth.motions import FORCE_LIMIT

LARGEST_REACH = 0.5
"""How far behind a surface a set point may lie for the force that is wanted [m]."""
LEAST_REACH = 1e-3
"""A plan that could move by no more than this at a time is refused [m]."""
HARD = 6.0
"""Largest load that is foreseen [N]: what is felt on the way may be more by the stated error."""
_HELD = 0.35
"""Share of friction that should hold even where friction is much less than usual."""
_REACHED = 1e-6
Step = tuple[str, Move]


@dataclass(frozen=True)
class Planned:
    """One command [m, m, rad], and in words what it is for."""

    command: Command
    purpose: str


def diagnosis_plan(
    start: Float[Tensor, " 3"],
    floor_height: float,
    wall_position: float,
    stiffness: Float[Tensor, " 3"],
    steps: int,
    error: float,
) -> list[Planned]:
    """The start pose and `steps` commands that excite what a diagnosis looks for.

    `start` is a free pose of the hand [m, m, rad], `floor_height` the z and `wall_position` the x
    of the hand where the upright object touches them [m], right within `error` [m]. The last
    command lifts off. Raises ValueError for a start pose that is not free, where the error alone
    could mean too much force, or where the arm is so soft that set points lie far inside.
    """
    x, z, angle = start.tolist()
    if z <= floor_height + error or x >= wall_position - error:
        raise ValueError(
            f"the start pose ({x:g}, {z:g}) is not free: with an error of {error:g} m the hand"
            f" must be above {floor_height + error:g} (floor) and left of"
            f" {wall_position - error:g} (wall)"
        )
    reach = [FORCE_LIMIT / k - error for k in stiffness.tolist()[:2]]
    least = FORCE_LIMIT / max(stiffness.tolist()[:2]) - LEAST_REACH
    if least <= 0:
        raise ValueError(
            f"at a stiffness of {max(stiffness.tolist()[:2]):g} N/m a step of {LEAST_REACH:g} m"
            f" alone means {FORCE_LIMIT:g} N; give the arm a softer one"
        )
    if min(reach) <= LEAST_REACH:
        raise ValueError(
            f"error is {error:g} m, which at this stiffness alone means {FORCE_LIMIT:g} N; expected"
            f" floor and wall to be known within less than {least:g} m"
        )
    if max(reach) > LARGEST_REACH:
        raise ValueError(
            f"at a stiffness of {min(stiffness.tolist()[:2]):g} N/m a force of {FORCE_LIMIT:g} N"
            f" needs set points {max(reach):.3g} m behind the surface, expected at most"
            f" {LARGEST_REACH:g}; check that the stiffness is in N/m"
        )
    felt = Feel(
        x, z, (x, z, angle), floor_height, wall_position, False, False,
        USUAL_FRICTION, USUAL_FRICTION, (float(stiffness[0]), float(stiffness[1])),
    )  # fmt: skip
    plan = [Planned((x, z, angle), "start, free of contact")]
    for purpose, move in _moves():
        goal, ended = move(felt), False
        while not ended:
            if len(plan) == steps:
                return [*plan, Planned(_within(_lifted(felt), felt, reach), "lift off, end")]
            command = _within(goal, felt, reach)
            after = settled(felt, command)
            ended = (
                _distance(command, goal) < _REACHED
                or _distance((after.x, after.z, command[2]), (felt.x, felt.z, felt.command[2]))
                < _REACHED
            )
            plan.append(Planned(command, purpose if ended else f"on the way to: {purpose}"))
            felt = after
    raise AssertionError("moves never end")


def settled(felt: Feel, command: Command) -> Feel:
    """What a hand feels after a command, the object being one point that slides with friction."""
    (x, z, _), (kx, kz) = command, felt.stiffness
    floor_load, wall_load = kz * (felt.floor_z - z), kx * (x - felt.wall_x)
    if floor_load > 0:
        x = _dragged(x, felt.x, felt.floor_friction * floor_load / kx)
    if wall_load > 0:
        z = _dragged(z, felt.z, felt.wall_friction * wall_load / kz)
    return replace(
        felt,
        x=min(x, felt.wall_x),
        z=max(z, felt.floor_z),
        command=command,
        on_floor=floor_load > 0,
        at_wall=wall_load > 0,
    )


def _dragged(goal: float, here: float, most: float) -> float:
    """Where friction leaves what is drawn to a goal from here, held back by `most` [m]."""
    if abs(goal - here) <= most:
        return here
    return goal - most if goal > here else goal + most


def _within(goal: Command, felt: Feel, reach: list[float]) -> Command:
    """The part of the way to a goal that keeps within the force limit."""
    x, z = (
        min(max(there, here - far), here + far)
        for there, here, far in zip(goal[:2], (felt.x, felt.z), reach, strict=True)
    )
    return x, z, goal[2]


def _lifted(felt: Feel) -> Command:
    return min(felt.x, felt.wall_x - 0.02), max(felt.z, felt.floor_z + CLEARANCE), 0.0


def _distance(a: Command, b: Command) -> float:
    return max(abs(one - other) for one, other in zip(a, b, strict=True))


def _moves() -> Iterator[Step]:
    """All visits over and over, turning the other way each time."""
    side = 1.0
    while True:
        for visit in _visits(side):
            yield from visit
        side = -side


def _visits(side: float) -> list[list[Step]]:
    left, right, middle = PLACES[0], PLACES[2], PLACES[1]
    return [
        [_press(HARD), _slide(LEFT, MEDIUM), _slide(RIGHT, MEDIUM), _hold(LEFT)],
        [_facing(), _wall_press(MEDIUM), _corner(HARD, HARD, side), _climb(HARD)],
        [_wall_slide(DOWN, LIGHT), _wall_slide(UP, HARD)],
        _free(middle, side),
        [
            _over(middle),
            *(_press(load) for load in (LIGHT, MEDIUM, HARD)),
            _hold(RIGHT),
            _hold(LEFT),
        ],
        [_nudge(RIGHT, HARD, excess) for excess in NUDGES],
        [_tilt(side, LIGHT), _tilt(side, HARD), _tilt(-side, HARD), _tilt(-side, LIGHT)],
        [_slide(LEFT, HARD), _slide(RIGHT, HARD), _pause()],
        [("peel off the floor by a little", peel)],
        [_facing(0.03), *(_wall_press(load) for load in (LIGHT, MEDIUM, HARD))],
        [_wall_slide(UP, HARD), _wall_slide(DOWN, HARD), _pause()],
        [_wall_slide(UP, LIGHT), _wall_slide(DOWN, LIGHT), _wall_tilt(side), _wall_tilt(-side)],
        [("peel off the wall by a little", wall_peel)],
        [_over(left), _press(HARD), *(_nudge(LEFT, HARD, excess) for excess in NUDGES)],
        [_slide(LEFT, LIGHT), _slide(RIGHT, LIGHT), _over(right), _press(MEDIUM)],
        [_corner(MEDIUM, MEDIUM), _corner(MEDIUM, HARD, side)],
        [*_free(left, -side), _press(MEDIUM), ("peel off the floor by a little", peel)],
    ]


def _free(place: float, side: float) -> list[Step]:
    def at(dx: float, dz: float, angle: float) -> Move:
        return lambda felt: (felt.wall_x - place + dx, felt.floor_z + CLEARANCE + dz, angle)

    there = at(0.02 * side, 0.02, side * TILT), at(-0.015 * side, 0.0, -side * TILT)
    purposes = "move and turn in free space", "move and turn back in free space"
    return [_over(place), *zip(purposes, there, strict=True), _pause()]


def _press(load: float) -> Step:
    return f"press {load:g} N on the floor", press(load)


def _slide(direction: float, load: float) -> Step:
    return f"slide {'right' if direction > 0 else 'left'} at {load:g} N", slide(direction, load)


def _nudge(direction: float, load: float, excess: float) -> Step:
    way = "right" if direction > 0 else "left"
    purpose = f"push {way} at {load:g} N with {excess:g} times what should make it slide"
    return purpose, nudge(direction, load, excess)


def _hold(direction: float) -> Step:
    """Push along the floor with a third of what friction holds."""

    def move(felt: Feel) -> Command:
        kx, kz = felt.stiffness
        reach = _HELD * felt.floor_friction * HARD / kx
        return felt.x + direction * reach, felt.floor_z - HARD / kz, 0.0

    return f"push {'right' if direction > 0 else 'left'} at {HARD:g} N, too little to slide", move


def _tilt(side: float, load: float) -> Step:
    return f"turn {'left' if side > 0 else 'right'} at {load:g} N on the floor", tilt(side, load)


def _wall_tilt(side: float) -> Step:
    return f"turn {'left' if side > 0 else 'right'} at {MEDIUM:g} N on the wall", wall_tilt(side)


def _wall_press(load: float) -> Step:
    return f"press {load:g} N on the wall", wall_press(load)


def _wall_slide(direction: float, load: float) -> Step:
    way = "up" if direction > 0 else "down"
    return f"slide {way} the wall at {load:g} N", wall_slide(direction, load)


def _climb(load: float) -> Step:
    return f"climb the wall at {load:g} N", climb(load)


def _corner(wall_load: float, floor_load: float, side: float = 0.0) -> Step:
    turned = "" if side == 0 else ", turned"
    purpose = f"press {wall_load:g} N on the wall and {floor_load:g} N on the floor{turned}"
    return purpose, corner(wall_load, floor_load, side)


def _over(place: float) -> Step:
    return f"lift off, {1e3 * place:g} mm left of the wall", above(place)


def _facing(higher: float = 0.0) -> Step:
    def move(felt: Feel) -> Command:
        x, z, angle = facing_wall(felt)
        return x, z + higher, angle

    return f"lift off, facing the wall{' higher up' if higher else ''}", move


def _pause() -> Step:
    return "pause", pause
