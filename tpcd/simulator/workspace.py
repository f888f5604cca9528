"""What the compiled search for a rest pose works on: the law that all elements share, and room
for one element, made once for each thread.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np

from tpcd.loops import inner

LIST = 8
"""Candidate points kept for each terrain."""


class Law(NamedTuple):
    """What all elements share: impedance, its root, and the settings of the step.

    `room` has as many entries as rows can carry load at once, k: the degrees of freedom, three
    where all terrains are rigid, and where they yield three and the number of terrains. Its length
    is a part of its type, so that loops over it are compiled for either.
    """

    stiffness: np.ndarray
    root: np.ndarray
    coulomb: bool
    rounds: int
    tolerance: float
    room: tuple[float, ...]


class System(NamedTuple):
    """The rest equations of the k loaded rows, as filled by `linear_system`.

    `rows` (k, 3) of the constraints, `pushes` (k, 3) of their forces, `soft` (3, 3) inverse
    stiffness, `left` (k, 3) rows times that and `push` (k, 3) that times forces, `unbalanced` (3)
    and `violated` (k) residuals of the balance and of the rows, `inverse` (k, k) of the Schur
    complement, `starts` (k, 3) how rows move with the start pose.
    """

    rows: np.ndarray
    pushes: np.ndarray
    soft: np.ndarray
    unbalanced: np.ndarray
    violated: np.ndarray
    inverse: np.ndarray
    starts: np.ndarray
    left: np.ndarray
    push: np.ndarray


class Elastic(NamedTuple):
    """Room for a problem of w rows that give way: `rows` (w, k + w), `motion` (k + w), `slots` (w),
    `work` (w + 5, k + w)."""

    rows: np.ndarray
    motion: np.ndarray
    slots: np.ndarray
    work: np.ndarray


class Tape(NamedTuple):
    """Solutions of the contact problems of b elements by another backend, in the order in which
    they come up, and the problem that comes next.

    `motion` (b, c, k), `multipliers` (b, c, w) and `status` (b, c) of problems whose solution is
    `known` (b); the next one has `wanted` (b) unit whitened rows, 0 where an element is done,
    `rows` (b, w, k) and `values` (b, w). Without elements (b = 0) problems are solved where they
    come up.
    """

    motion: np.ndarray
    multipliers: np.ndarray
    status: np.ndarray
    known: np.ndarray
    wanted: np.ndarray
    rows: np.ndarray
    values: np.ndarray


class Recall(NamedTuple):
    """The tape of one element: `motion` (c, k), `multipliers` (c, w), `status` (c), and in `cursor`
    (3) the next problem, how many solutions are known (-1: solve it here), and the rows that the
    next problem has, once it is reached."""

    motion: np.ndarray
    multipliers: np.ndarray
    status: np.ndarray
    cursor: np.ndarray


class Space(NamedTuple):
    """Everything one element works on.

    Candidates of terrain t (t, LIST): `listed` who, `place` (.., 6) its coordinates in the
    end-effector frame, its arm from the end effector at the part's start in world axes, and where
    it was then, `record` (.., 6) its contact at the last pose: gap, normal (x, z), height over the
    end effector, lever, and curvature.
    Rows of the contact problem, up to 2 t LIST of them: `rows`, `values`, `sizes`,
    `lengths`, `multipliers`, and in `source` (.., 2) terrain and place on the list. The k
    rows that may carry load (`room`, as in `Law`): `chosen` (k, 3) point (-1 where free), terrain
    and place, `multiplier`, `side`, `slipping`; `slid` (1) whether one of them moved along its
    terrain. `friction` keeps that of a jammed step while it is answered without.
    """

    room: tuple[float, ...]
    listed: np.ndarray
    counts: np.ndarray
    place: np.ndarray
    record: np.ndarray
    load: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    sizes: np.ndarray
    lengths: np.ndarray
    multipliers: np.ndarray
    source: np.ndarray
    motion: np.ndarray
    slots: np.ndarray
    work: np.ndarray
    system: System
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
    elastic: Elastic
    recall: Recall


@inner(_nrt=True)
@no_type_check
def new_space(terrains, room, calls):
    """Room for one element at a time against so many terrains, for so many loaded rows, and for so
    many solutions of another backend."""
    width, k = 2 * terrains * LIST, len(room)
    return Space(
        room,
        np.zeros((terrains, LIST), np.int64),
        np.zeros(terrains, np.int64),
        np.zeros((terrains, LIST, 6)),
        np.zeros((terrains, LIST, 6)),
        np.zeros(terrains),
        np.empty((width, k)),
        np.empty(width),
        np.empty(width),
        np.empty(width),
        np.empty(width),
        np.zeros((width, 2), np.int64),
        np.empty(k),
        np.zeros(k, np.int64),
        np.empty((k + 5, k)),
        System(
            np.empty((k, 3)),
            np.empty((k, 3)),
            np.zeros((3, 3)),
            np.empty(3),
            np.empty(k),
            np.empty((k, k)),
            np.empty((k, 3)),
            np.empty((k, 3)),
            np.empty((k, 3)),
        ),
        np.zeros((k, 3), np.int64),
        np.zeros(k),
        np.zeros(k),
        np.zeros(k, np.bool_),
        np.zeros(1, np.bool_),
        np.empty(3),
        np.empty(k),
        np.empty(3),
        np.empty(k),
        np.empty(k),
        np.zeros(terrains),
        Elastic(
            np.empty((width, k + width)),
            np.empty(k + width),
            np.zeros(width, np.int64),
            np.empty((width + 5, k + width)),
        ),
        Recall(
            np.empty((calls, k)),
            np.empty((calls, width)),
            np.zeros(calls, np.int64),
            np.array([0, -1, 0]),
        ),
    )


@inner
@no_type_check
def begin_recall(space, tape, b):
    """Take over what is known of element b; whether it is to be evaluated."""
    cursor = space.recall.cursor
    cursor[0], cursor[1], cursor[2] = 0, -1, 0
    if len(tape.known) == 0:
        return True
    if tape.wanted[b] == 0:
        return False
    cursor[1] = tape.known[b]
    for c in range(tape.known[b]):
        for a in range(len(space.room)):
            space.recall.motion[c, a] = tape.motion[b, c, a]
        for r in range(space.multipliers.shape[0]):
            space.recall.multipliers[c, r] = tape.multipliers[b, c, r]
        space.recall.status[c] = tape.status[b, c]
    return True


@inner
@no_type_check
def end_recall(space, tape, b):
    """Leave the problem that came up last, if its solution is not known."""
    if len(tape.known) == 0:
        return
    tape.wanted[b] = space.recall.cursor[2]
    for r in range(space.recall.cursor[2]):
        tape.values[b, r] = space.values[r]
        for a in range(len(space.room)):
            tape.rows[b, r, a] = space.rows[r, a]
