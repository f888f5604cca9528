"""Random contact problems like those of the simulator: points of an object near floor and wall.

Each contact gives two rows, the edges (n + mu t)^T J and (n - mu t)^T J of its friction
cone, in the planar motion (dx, dz, dphi) of the end effector. Problems have between one
contact and as many as fit, so most are padded; part of them hold what makes contact
problems hard: exact duplicates, flat faces (more points on one edge than it takes), both
terrains at once, and, on request, penetrating starts with friction above 1 (which can jam).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tpcd.qp import ContactQP

STIFFNESS = (100.0, 100.0, 50.0)
"""Of the impedance [N/m, N/m, N·m/rad]."""


@dataclass(frozen=True)
class ContactRecipe:
    """How random contact problems are made."""

    friction: tuple[float, float] = (0.1, 0.9)
    """Range of the friction coefficient; one for each problem."""
    gaps: tuple[float, float] = (-0.0005, 0.004)
    """Range of the gaps at the start [m]; negative ones penetrate."""
    wall_share: float = 0.3
    """Share of contacts with the wall instead of the floor."""
    flat_share: float = 0.3
    """Share of problems whose floor contacts lie on one edge of the object."""
    duplicate_share: float = 0.2
    """Share of problems whose second contact repeats the first exactly."""
    stiffness_decades: float = 0.0
    """The stiffness is scaled by 10^U(-d, d), one factor for each problem; 0 shares it."""


def random_contact_problems(
    count: int, rows: int, seed: int, recipe: ContactRecipe | None = None
) -> ContactQP:
    """Make `count` problems of 3 variables and `rows` (even) rows, float64 on the CPU."""
    if rows % 2 or rows < 2:
        raise ValueError(f"rows is {rows}, expected an even number: two for each contact")
    recipe = recipe or ContactRecipe()
    random = np.random.default_rng(seed)
    contacts = rows // 2
    shape = (count, contacts)
    present = np.arange(contacts) < random.integers(1, contacts + 1, (count, 1))
    on_wall = random.random(shape) < recipe.wall_share
    gaps = random.uniform(*recipe.gaps, shape)
    x = np.where(on_wall, random.normal(0.05, 0.01, shape), random.uniform(-0.06, 0.06, shape))
    z = np.where(on_wall, random.uniform(-0.06, 0.06, shape), random.normal(-0.05, 0.01, shape))

    # On a flat face all points have one z in the object and gaps linear along the edge;
    # half of the faces lie exactly parallel to the floor.
    flat = (random.random((count, 1)) < recipe.flat_share) & ~on_wall
    slope = random.normal(0.0, 0.02, (count, 1)) * (random.random((count, 1)) < 0.5)
    edge = gaps[:, :1] + slope * (x - x[:, :1])
    z = np.where(flat, z[:, :1] + slope * (x - x[:, :1]), z)
    gaps = np.where(flat, edge, gaps)
    if contacts > 1:
        twin = random.random(count) < recipe.duplicate_share
        for values in (x, z, gaps, on_wall):
            values[twin, 1] = values[twin, 0]

    normal_x, normal_z = np.where(on_wall, -1.0, 0.0), np.where(on_wall, 0.0, 1.0)
    friction = random.uniform(*recipe.friction, (count, 1))
    edges = [
        _row(normal_x - sign * friction * normal_z, normal_z + sign * friction * normal_x, x, z)
        for sign in (1.0, -1.0)
    ]
    scatter = random.normal(size=(count, 3)) * (0.01, 0.01, 0.08)
    stiffness = np.diag(STIFFNESS)
    if recipe.stiffness_decades:
        exponent = random.uniform(-1, 1, (count, 1, 1)) * recipe.stiffness_decades
        stiffness = stiffness * 10.0**exponent
    return ContactQP(
        hessian=torch.from_numpy(stiffness),
        target=torch.from_numpy(scatter + (0.004, -0.006, 0.0)),
        rows=torch.from_numpy(np.stack(edges, axis=2).reshape(count, rows, 3)),
        offsets=torch.from_numpy(np.repeat(gaps, 2, axis=1)),
        row_mask=torch.from_numpy(np.repeat(present, 2, axis=1)),
    )


def _row(direction_x: np.ndarray, direction_z: np.ndarray, x: np.ndarray, z: np.ndarray):
    """Gradient of a contact point's motion along a direction, in (dx, dz, dphi)."""
    return np.stack((direction_x, direction_z, direction_z * x - direction_x * z), axis=-1)
