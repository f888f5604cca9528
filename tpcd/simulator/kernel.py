"""The quasi-static step for half-plane terrains in compiled loops, one transition after the other.

`kernel_geometry` finds lowest points and first touches, `kernel_settle` the rest pose,
`kernel_linear` and `kernel_slopes` the derivatives, `kernel_element` strings the parts of a
transition together. Imported only where numba is.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import no_type_check

import numpy as np
from numba import njit

from tpcd import parameters
from tpcd.qp import compiled, problem
from tpcd.simulator import events, implicit, loaded, record, settle, walk, wedge
from tpcd.simulator.kernel_element import step_element
from tpcd.simulator.kernel_geometry import World, new_chains
from tpcd.simulator.kernel_request import new_planes, own_law, prepare, set_planes, set_stiffness
from tpcd.simulator.kernel_slopes import SceneSlopes, new_slopes
from tpcd.simulator.kernel_space import new_space


def source_stamp(*more: ModuleType) -> int:
    """A number for the sources of everything compiled here, and in more modules.

    numba's cache looks only at the file of the function it keeps, so what changes in the
    files it calls, or takes constants from, must be part of the key, or old code would run.
    """
    digest = hashlib.sha256()
    parts = [part for name, part in sorted(sys.modules.items()) if name.startswith(__name__)]
    others = (compiled, problem, parameters, events, implicit, loaded, record, settle, walk, wedge)
    for module in (*parts, *others, *more):
        digest.update(Path(str(module.__file__)).read_bytes())
    return int.from_bytes(digest.digest()[:6], "big")


def _compile_step_range(stamp: int) -> Callable[..., None]:
    """The entry, the only function kept in numba's cache; `stamp` makes part of its key."""

    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def step_range(world, law, request, answer, first, last):
        if stamp >= 0:
            _step_range(world, law, request, answer, first, last)

    return step_range


@njit(inline="always")
@no_type_check
def _step_range(world, law, request, answer, first, last):
    """Step the transitions from `first` up to `last`."""
    terrains, count = world.normals.shape[1], world.points.shape[2]
    chains, space = new_chains(terrains, count), new_space(terrains, law.room)
    slopes = new_slopes(terrains, 0, law.room)
    # No entries of theta; an element of it is named by a variable, as in the likelihood, since for
    # a constant the step would be compiled once more.
    by_theta = SceneSlopes(
        np.zeros((1, 0, 2, 1)), np.zeros((1, 0, terrains)), np.zeros((1, 0, terrains))
    )
    poses = np.zeros((7, 3))
    normals, offsets, friction, compliance = new_planes(terrains)
    law = own_law(law)
    b = first
    while b < last:
        # Transitions of one outline that follow each other share its chains.
        o, end = request.owner[b], b + 1
        while end < last and request.owner[end] == o:
            end += 1
        here = World(world.points[o : o + 1], normals, offsets, friction, compliance)
        set_planes(here, world, request.place[b])
        extent = prepare(here, 0, law, request, b, end, chains)
        for element in range(b, end):
            set_planes(here, world, request.place[element])
            set_stiffness(law, request.stiffness[element if request.stiffness.shape[0] > 1 else 0])
            step_element(
                here, 0, chains, law, extent, request, element, answer, space, slopes, poses,
                by_theta, o,
            )  # fmt: skip
        b = end


step_range = _compile_step_range(source_stamp())
"""Step the transitions `first` up to `last`: (world, law, request, answer, first, last).

Fills their part of the answer in place and releases the interpreter lock meanwhile.
"""
