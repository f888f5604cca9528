"""The quasi-static step, one transition after the other.

`geometry` finds lowest points and first touches, `rest` the rest pose, `response` and `tangents`
the derivatives, and `element` strings the parts of a transition together.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import no_type_check

import numpy as np

from tpcd import loops, parameters, terrain
from tpcd.geometry import candidates, query, surfaces
from tpcd.geometry.candidates import World, new_chains
from tpcd.geometry.query import own_surfaces
from tpcd.loops import njit
from tpcd.qp import active_set, elastic, problem
from tpcd.simulator import (
    element,
    events,
    path,
    record,
    request,
    residual,
    response,
    rest,
    tangents,
    wedging,
    workspace,
)
from tpcd.simulator.element import step_element
from tpcd.simulator.request import new_planes, own_law, prepare, set_planes, set_stiffness
from tpcd.simulator.tangents import BY_ALL, NOTHING_MORE, new_slopes
from tpcd.simulator.workspace import begin_recall, end_recall, new_space

_SOURCES = (
    active_set, candidates, elastic, element, events, loops, parameters, path, problem, query,
    record, request, residual, response, rest, surfaces, tangents, terrain, wedging, workspace,
)  # fmt: skip
"""What is compiled here, and where its constants are from."""


def source_stamp(*more: ModuleType) -> int:
    """A number for the sources of everything compiled here, and in more modules.

    numba's cache looks only at the file of the function it keeps, so what changes in the
    files it calls, or takes constants from, must be part of the key, or old code would run.
    """
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for module in (*_SOURCES, *more):
        digest.update(Path(str(module.__file__)).read_bytes())
    return int.from_bytes(digest.digest()[:6], "big")


def _compile_step_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def step_range(world, law, asked, answer, tape, first, last):
        if stamp >= 0:
            _step_range(world, law, asked, answer, tape, first, last)

    return step_range


@njit(inline="always")
@no_type_check
def _step_range(world, law, asked, answer, tape, first, last):
    """Step the transitions from `first` up to `last`."""
    terrains, count = world.friction.shape[1], world.points.shape[2]
    chains, space = new_chains(terrains, count), new_space(terrains, law.room, tape.motion.shape[1])
    level = BY_ALL if answer.from_inputs.shape[1] > 0 else NOTHING_MORE
    slopes = new_slopes(terrains, count, level, law.room)
    poses = np.zeros((7, 3))
    where, clearance, friction, compliance = new_planes(terrains)
    own = own_surfaces(world.surfaces)
    law = own_law(law)
    b = first
    while b < last:
        # Transitions of one outline that follow each other share its chains.
        o, end = asked.owner[b], b + 1
        while end < last and asked.owner[end] == o:
            end += 1
        here = World(world.points[o : o + 1], own, where, clearance, friction, compliance)
        set_planes(here, world, asked.place[b])
        extent = prepare(here, 0, law, asked, b, end, chains)
        for i in range(b, end):
            if not begin_recall(space, tape, i):
                continue
            set_planes(here, world, asked.place[i])
            set_stiffness(law, asked.stiffness[i if asked.stiffness.shape[0] > 1 else 0])
            step_element(here, 0, chains, law, extent, asked, i, answer, space, slopes, poses)
            end_recall(space, tape, i)
        b = end


step_range = _compile_step_range(source_stamp())
"""Step the transitions `first` up to `last`: (world, law, asked, answer, tape, first, last).

Fills their part of the answer in place and releases the interpreter lock meanwhile.
"""
