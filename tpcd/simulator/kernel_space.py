"""What the compiled search for a rest pose works on: the law that all elements share, and room
for one element, made once for each thread.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.simulator.kernel_inner import inner

LIST = 8
"""Candidate points kept for each terrain."""


class Law(NamedTuple):
    """What all elements share: impedance, its root, and the settings of the step."""

    stiffness: np.ndarray
    root: np.ndarray
    coulomb: bool
    rounds: int
    tolerance: float
    compliance: float


class Space(NamedTuple):
    """Everything one element works on.

    Candidates of terrain t (t, LIST): `listed` who, `place` (.., 4) its coordinates in the
    end-effector frame, its tangential position at the start and the start's tangent lever.
    Rows of the contact problem, up to 2 t LIST of them: `rows`, `values`, `sizes`,
    `lengths`, `multipliers`, and in `source` (.., 2) terrain and place on the list. The three
    rows that may carry load: `chosen` (3, 3) point (-1 where free), terrain and place,
    `multiplier`, `side`, `slipping`; `slid` (1) whether one of them moved along its terrain.
    `system` (15, 3) as filled by `linear_system`. `friction` keeps that of a jammed step while it
    is answered without.
    """

    listed: np.ndarray
    counts: np.ndarray
    place: np.ndarray
    load: np.ndarray
    before: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    sizes: np.ndarray
    lengths: np.ndarray
    multipliers: np.ndarray
    source: np.ndarray
    motion: np.ndarray
    slots: np.ndarray
    work: np.ndarray
    system: np.ndarray
    chosen: np.ndarray
    multiplier: np.ndarray
    side: np.ndarray
    slipping: np.ndarray
    slid: np.ndarray
    force: np.ndarray
    right: np.ndarray
    change: np.ndarray
    gain: np.ndarray
    margins: np.ndarray
    friction: np.ndarray


@inner(_nrt=True)
@no_type_check
def new_space(terrains):
    """Room for one element at a time against so many terrains."""
    width = 2 * terrains * LIST
    return Space(
        np.zeros((terrains, LIST), np.int64),
        np.zeros(terrains, np.int64),
        np.zeros((terrains, LIST, 4)),
        np.zeros(terrains),
        np.zeros(terrains),
        np.empty((width, 3)),
        np.empty(width),
        np.empty(width),
        np.empty(width),
        np.empty(width),
        np.zeros((width, 2), np.int64),
        np.empty(3),
        np.zeros(3, np.int64),
        np.empty((8, 3)),
        np.empty((15, 3)),
        np.zeros((3, 3), np.int64),
        np.zeros(3),
        np.zeros(3),
        np.zeros(3, np.bool_),
        np.zeros(1, np.bool_),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.zeros(terrains),
    )
