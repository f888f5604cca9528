"""Objects, scenes and steps for tests of effects injected into MuJoCo."""

from __future__ import annotations

import math

import numpy as np
import torch

from tpcd.truth.injected import InjectedMujocoTruth
from tpcd.truth.mujoco_truth import MujocoSettings
from tpcd.truth.scene import Scene

FORCE = 5e-3
"""Closed forms hold to this [N]; torques to the same number [N·m]."""
LENGTH = 3e-5
"""Closed forms hold to this [m]."""


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


SLAB = vector(-0.05, -0.03, 0.05, -0.03, 0.05, 0.03, -0.05, 0.03).reshape(4, 2)
TOWER = SLAB.flip(-1).flip(0)
"""The slab on its end: it meets the wall with a long face."""
WEDGE = vector(0.0, -0.05, 0.04, 0.05, -0.04, 0.05).reshape(3, 2)
"""Touches the floor in one point below the hand."""
HOOK = vector(0.04, -0.05, 0.05, 0.05, -0.05, 0.05).reshape(3, 2)
"""Touches the floor in one point to the right of the hand."""
NOMINAL = 0.4
PRESS_1, PRESS_2 = (0.0, 0.01, 0.0), (0.0, -0.03, 0.0)
"""Commands 20 and 60 mm deep for the slab on the floor at zero."""


def make_scene(vertices=SLAB, friction=NOMINAL, floor=0.0, wall=0.5, start=(0.0, 0.06, 0.0)):
    stiffness = vector(100.0, 100.0, 50.0)
    mount = vector(0.0, 0.0, 0.0)
    return Scene("s", vertices, 1.0, mount, friction, floor, wall, vector(*start), stiffness)


def follow(hidden, *commands, steps=None, settings=None, **scene) -> np.ndarray:
    """Rows (n, 6) of pose and wrench; every step settles and agrees with the contact forces."""
    settings = settings or MujocoSettings()
    truth = InjectedMujocoTruth(make_scene(**scene), hidden, steps or len(commands), settings)
    rows = []
    for command in commands:
        pose, wrench, settled = truth.step(vector(*command))
        assert settled
        assert torch.allclose(wrench, truth.external_wrench(), atol=FORCE)
        rows.append(torch.cat((pose, wrench)).numpy())
    return np.array(rows)


def lowest(vertices: torch.Tensor, pose: np.ndarray, turn: float = 0.0, shift: float = 0.0):
    """World position of the lowest vertex, the object turned and shifted in the hand."""

    def rotate(points, angle):
        cosine, sine = math.cos(angle), math.sin(angle)
        return points @ np.array([[cosine, sine], [-sine, cosine]])

    held = rotate(vertices.numpy(), turn) + [shift, 0.0]
    points = rotate(held, pose[2]) + pose[:2]
    return points[points[:, 1].argmin()]


def random_commands(seed: int, steps: int = 6) -> list[list[float]]:
    generator = np.random.default_rng(seed)
    return generator.uniform((-0.02, -0.01, -0.15), (0.09, 0.05, 0.15), (steps, 3)).tolist()
