"""A motion that excites every effect a diagnosis may look for, the informative part first.

By about 15 commands it has pressed and slid on floor and wall at two loads, and moved, turned
and paused in free space; by 30 it has pressed one spot of the floor at three loads, pushed
along it without and with slip, and turned under load both ways; by 60 it has done the same on
the wall, slid both ways on both at two loads, and touched the floor at three places. From then
on it goes on with random visits of the same kinds.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence

import torch

from tpcd.truth.contact_feel import Command, Feel, as_command, feel
from tpcd.truth.motions import (
    LARGEST_DRAG,
    SEARCH_STEP_DOWN,
    History,
    Script,
    ScriptedMotion,
)

LOADS = LIGHT, MEDIUM, HARD = (1.5, 3.5, 7.0)
"""Pressed at each spot [N]."""
LEFT, RIGHT = DOWN, UP = (-1.0, 1.0)
"""Directions of slides."""
PLACES = (0.085, 0.05, 0.018)
"""Where the floor is touched: left of where the hand meets the wall [m]."""
SLIDE, WALL_SLIDE = 0.025, 0.018
"""Distances of slides on the floor and on the wall [m]."""
STRIDE = 0.055
"""Of the search for the wall [m], which is hit with about 5.5 N at 100 N/m, and never with more
than `FORCE_LIMIT`."""
CLEARANCE = 0.035
"""Height of free moves, and of the hand on the wall, over the floor [m]."""
HELD, NUDGES = 0.85, (1.1, 1.25)
"""Pushes along a surface relative to what kinetic friction holds: less, and what static could."""
PEEL = 0.005
"""Height at which it is tried whether a surface lets go [m]: 0.5 N at 100 N/m."""
TILT = 0.12
"""Commanded angle either way [rad]."""
Move = Callable[[Feel], Command]


def diagnosis_motion(generator: torch.Generator) -> ScriptedMotion:
    """Explore so that the effects of a diagnosis can be told apart.

    Reaches floor and wall within 15 steps for objects of a hand's size that start up to
    about 40 mm above the floor and 150 mm from the wall.
    """
    return ScriptedMotion(lambda history: _script(history, generator))


def _script(history: History, generator: torch.Generator) -> Script:
    side = 1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0
    history = yield from _descend(history)
    first = [press(HARD), slide(LEFT, MEDIUM), lean(RIGHT, HARD)]
    history = yield from _follow(history, first)
    history = yield from _search_wall(history)
    for visit in (
        [corner(HARD, HARD, side), climb(HARD), wall_slide(DOWN, LIGHT), wall_slide(UP, HARD)],
        [above(PLACES[1]), pause, free(PLACES[1], -0.02, 0.02, side * TILT)],
        [above(PLACES[1]), *_press_at_loads(press), *_pushes(HARD)],
        [tilt(side, LIGHT), tilt(side, HARD), tilt(-side, HARD), tilt(-side, LIGHT)],
        [slide(LEFT, HARD), slide(RIGHT, HARD), pause, peel],
        [facing_wall, *_press_at_loads(wall_press)],
        [wall_slide(UP, HARD), wall_slide(DOWN, HARD), pause],
        [wall_slide(UP, LIGHT), wall_slide(DOWN, LIGHT), wall_tilt(side), wall_tilt(-side)],
        [wall_peel, above(PLACES[0]), press(HARD), *(nudge(LEFT, HARD, n) for n in NUDGES)],
        [slide(LEFT, LIGHT), slide(RIGHT, LIGHT), above(PLACES[2]), press(MEDIUM)],
        [corner(MEDIUM, MEDIUM), corner(MEDIUM, HARD, side)],
        [above(PLACES[2]), press(LIGHT), slide(LEFT, MEDIUM), slide(RIGHT, MEDIUM)],
        [*_free_visit(PLACES[0], -side), press(MEDIUM), peel],
    ):
        history = yield from _follow(history, visit)
    while True:
        history = yield from _follow(history, _random_visit(generator))


def _random_visit(generator: torch.Generator) -> list[Move]:
    """A few moves on floor or wall, in the corner or in free space."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def load() -> float:
        return uniform(LIGHT, HARD)

    side = 1.0 if uniform(0.0, 1.0) < 0.5 else -1.0
    place, kind = uniform(PLACES[2], PLACES[0]), uniform(0.0, 1.0)
    if kind < 0.4:
        held = load()
        slides = [slide(side, held), slide(-side, held)]
        presses = [press(load()), press(load())]
        return [above(place), *presses, *slides, tilt(side, load()), pause, peel]
    if kind < 0.75:
        held = load()
        slides = [wall_slide(side, held), wall_slide(-side, held)]
        presses = [wall_press(load()), wall_press(load())]
        return [facing_wall, *presses, *slides, wall_tilt(side), wall_peel]
    if kind < 0.9:
        return [corner(load(), load()), corner(load(), load(), side), climb(load())]
    return _free_visit(place, side)


def _free_visit(place: float, side: float) -> list[Move]:
    """Lift, wait, then move and turn in free space one way and the other on every axis."""
    there, back = free(place, 0.02 * side, 0.02, TILT), free(place, -0.015 * side, 0.0, -TILT)
    return [above(place), pause, there, back]


def _pushes(load: float) -> list[Move]:
    """Push to and fro without sliding, and then with more and more."""
    leans = [lean(way, load) for way in (RIGHT, LEFT, RIGHT)]
    return [*leans, *(nudge(RIGHT, load, excess) for excess in NUDGES)]


def _press_at_loads(kind: Callable[[float], Move]) -> list[Move]:
    return [kind(load) for load in LOADS]


def pause(felt: Feel) -> Command:
    """The last command again."""
    return felt.command


def press(load: float) -> Move:
    """Down to a load [N] on the floor below the hand, upright."""
    return lambda felt: (felt.x, _down(felt, load), 0.0)


def tilt(side: float, load: float = MEDIUM) -> Move:
    """Turn under a load [N] on the floor."""
    return lambda felt: (felt.x, felt.floor_z - load / felt.stiffness[1], side * TILT)


def slide(direction: float, load: float) -> Move:
    """Along the floor by `SLIDE` beyond what friction holds, to the right for 1."""

    def move(felt: Feel) -> Command:
        reach = SLIDE + felt.floor_friction * load / felt.stiffness[0]
        return felt.x + direction * reach, _down(felt, load), 0.0

    return move


def lean(direction: float, load: float) -> Move:
    """Along the floor with less than friction holds, which only moves what yields."""

    def move(felt: Feel) -> Command:
        reach = HELD * felt.floor_friction * load / felt.stiffness[0]
        return felt.x + direction * reach, _down(felt, load), 0.0

    return move


def nudge(direction: float, load: float, excess: float) -> Move:
    """Along the floor with `excess` times what kinetic friction holds, which static could."""

    def move(felt: Feel) -> Command:
        reach = excess * felt.floor_friction * load / felt.stiffness[0]
        return felt.x + direction * reach, _down(felt, load), 0.0

    return move


def peel(felt: Feel) -> Command:
    """Off the floor by so little that a sticky one would still hold the object."""
    return felt.x, felt.floor_z + PEEL, 0.0


def wall_peel(felt: Feel) -> Command:
    """Off the wall by so little that a sticky one would still hold the object."""
    return felt.wall_x - PEEL, max(felt.z, felt.floor_z + CLEARANCE / 2), 0.0


def above(place: float) -> Move:
    """Off to free space over a place on the floor, left of the wall by so much [m]."""
    return free(place, 0.0, 0.0, 0.0)


def free(place: float, dx: float, dz: float, angle: float) -> Move:
    """To free space, dx and dz [m] from where `above` goes, turned by an angle [rad]."""
    return lambda felt: (felt.wall_x - place + dx, felt.floor_z + CLEARANCE + dz, angle)


def facing_wall(felt: Feel) -> Command:
    """Off to free space left of the wall, clear of the floor."""
    return felt.wall_x - 0.02, felt.floor_z + CLEARANCE, 0.0


def wall_press(load: float) -> Move:
    """Right to a load [N] on the wall beside the hand, upright and clear of the floor."""

    def move(felt: Feel) -> Command:
        return _right(felt, load), max(felt.z, felt.floor_z + CLEARANCE / 2), 0.0

    return move


def wall_tilt(side: float, load: float = MEDIUM) -> Move:
    """Turn under a load [N] on the wall."""

    def move(felt: Feel) -> Command:
        z = max(felt.z, felt.floor_z + CLEARANCE)
        return felt.wall_x + load / felt.stiffness[0], z, side * TILT

    return move


def wall_slide(direction: float, load: float) -> Move:
    """Along the wall by `WALL_SLIDE` beyond what friction holds, up for 1."""

    def move(felt: Feel) -> Command:
        reach = WALL_SLIDE + felt.wall_friction * load / felt.stiffness[1]
        return _right(felt, load), felt.z + direction * reach, 0.0

    return move


def climb(load: float) -> Move:
    """Up the wall from the floor, to where it can be slid on both ways."""

    def move(felt: Feel) -> Command:
        held = felt.wall_friction * load / felt.stiffness[1]
        return _right(felt, load), felt.floor_z + CLEARANCE + held, 0.0

    return move


def corner(wall_load: float, floor_load: float, side: float = 0.0) -> Move:
    """Into the corner with loads [N] on both, perhaps turned."""

    def move(felt: Feel) -> Command:
        return _right(felt, wall_load), _down(felt, floor_load), side * TILT

    return move


def _down(felt: Feel, load: float) -> float:
    """Command in z for a load on the floor, from where it was met last."""
    return (felt.z if felt.on_floor else felt.floor_z) - load / felt.stiffness[1]


def _right(felt: Feel, load: float) -> float:
    return (felt.x if felt.at_wall else felt.wall_x) + load / felt.stiffness[0]


def _follow(history: History, moves: Sequence[Move]) -> Generator[Command, History, History]:
    for move in moves:
        history = yield move(feel(history))
    return history


def _descend(history: History) -> Generator[Command, History, History]:
    """Lower the command, upright, until the floor holds the hand back."""
    x, z, _ = as_command(history.commands[-1])
    felt = feel(history)
    while not felt.on_floor:
        z -= min(SEARCH_STEP_DOWN, 3.0 / felt.stiffness[1])
        history = yield (x, z, 0.0)
        felt = feel(history)
    return history


def _search_wall(history: History) -> Generator[Command, History, History]:
    """Right with a light load until more than friction holds the hand."""
    felt = feel(history)
    while not felt.at_wall:
        drag = min(felt.floor_friction * LIGHT, LARGEST_DRAG) / felt.stiffness[0]
        history = yield (felt.x + STRIDE + drag, _down(felt, LIGHT), 0.0)
        felt = feel(history)
    return history
