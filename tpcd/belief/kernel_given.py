"""What the compiled likelihood is given, and where its answers go."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tpcd.geometry.surfaces import HalfPlanes, SurfaceTable

OUTLIER_SQUARE = 16.3
"""Squared Mahalanobis distance (3 degrees of freedom, 0.1 %) from which a transition counts
as not explained: its covariance grows so that it stays at this distance."""

PASSES = 3
"""Times at most that a transition is stepped and brought in: the third is the first again, where
the second explains less."""
FAR = 3e-4
"""Change of a gap [m] by which a transition is stepped again: about its reading's noise."""


class Measured(NamedTuple):
    """What is known and asked of m particles over n transitions between r = n + 1 rows.

    `poses` (c, r, 3) and their `variance`, the same for all particles (c = 1) or one for each;
    `give` (c, r, 3) is that of `Conditions`. Values and `slopes` (n, j) of the bumps; `rest` (c, n)
    what the terms after each one can still add; `least` (m) what must be reached; `sd` (m) of the
    misfit; `used` (n) says which transitions count: the others part the history. `limit` of an
    innovation's square; by more than `far` [m] a gap has its transition stepped again. `grain` and
    `roughness` are those of the `MisfitField`.
    """

    poses: np.ndarray
    variance: np.ndarray
    give: np.ndarray
    bumps: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray
    least: np.ndarray
    sd: np.ndarray
    used: np.ndarray
    limit: float
    far: float
    grain: float
    roughness: float


class Given(NamedTuple):
    """What the arm is asked and what it meets, for m particles and r rows, or 1 of either.

    `commands` and `stiffness` (.., .., 3); `turns` (.., .., 1) the angle of the object in the
    hand besides its mount; `surfaces` a table of as many environments, row by row, `friction` and
    `compliance` (.., .., t). `warp` (.., .., 2, p) moves the outline of a row, p = 0 where none is.
    """

    commands: np.ndarray
    stiffness: np.ndarray
    turns: np.ndarray
    surfaces: HalfPlanes | SurfaceTable
    friction: np.ndarray
    compliance: np.ndarray
    warp: np.ndarray
    substeps: int
    finest: float
    largest_turn: float
    follow_path: bool


class SceneSlopes(NamedTuple):
    """How the scenes of the batch move with d entries of theta: points (.., d, 2, p) in the
    end-effector frame, offsets and friction (.., d, t) of the terrains. d = 0 asks nothing.
    """

    points: np.ndarray
    offsets: np.ndarray
    friction: np.ndarray


class Found(NamedTuple):
    """Where the answers go: log likelihood (m), field mean (m, c) and covariance (m, c, c),
    innovations and the logarithms of their units (m, n, 3) where they are asked for (else m = 0),
    and derivatives (m, d, n, 3) of the innovations by d entries of theta. `poses` (m, n, 3),
    `modes` (m, n, t) and `contacts` (m, n, t, 4) of the settled steps where they are asked for.
    """

    total: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    whitened: np.ndarray
    log_scale: np.ndarray
    slopes: np.ndarray
    poses: np.ndarray
    modes: np.ndarray
    contacts: np.ndarray
