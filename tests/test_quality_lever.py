"""From which side forces act: certain and right for most recordings, and mirrored with them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

from tpcd.data.episode import Episode
from tpcd.quality.lever import depth_of_contact
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

OBJECTS = ("soup_can", "phone", "pear", "hammer", "mug", "cordless_drill")
STD = (0.03, 0.03, 0.002)


@cache
def recorded(name: str, seed: int) -> Episode:
    """A recording of a diagnosis motion."""
    generator = torch.Generator().manual_seed(seed)
    scene = draw_scene(name, builtin_outlines()[name].vertices, generator)
    motion = make_motion("diagnosis", scene, 24, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 24, generator).true


def standard_errors(name: str, seed: int, sign: float = 1.0) -> float:
    """Depth of contact in standard errors, of a noisy recording of a diagnosis motion."""
    made = recorded(name, seed)
    noise = np.random.default_rng(seed).normal(0.0, STD, (len(made), 3))
    wrenches = (made.wrenches.numpy() + noise) * [1.0, 1.0, sign]
    depth, error = depth_of_contact(wrenches, sign * made.poses[:, 2].numpy(), STD[2])
    return depth / error


def test_most_recordings_show_the_side_that_forces_act_from_and_few_the_wrong_one() -> None:
    """Beyond five standard errors (88 % of 60 diagnosis motions, none the wrong way)."""
    found = np.array([standard_errors(name, seed) for name in OBJECTS for seed in range(2)])
    assert (found > 5.0).sum() >= 9
    assert (found < -5.0).sum() == 0


@pytest.mark.parametrize("name", OBJECTS[:2])
def test_a_mirrored_angle_and_torque_mirror_the_side(name: str) -> None:
    right, mirrored = standard_errors(name, 0), standard_errors(name, 0, -1.0)
    assert mirrored == pytest.approx(-right)


def test_what_does_not_press_tells_nothing() -> None:
    assert depth_of_contact(np.zeros((30, 3)), np.zeros(30), 0.01) == (0.0, np.inf)
    one_way = np.tile([0.0, 5.0, 0.1], (30, 1))
    assert depth_of_contact(one_way, np.zeros(30), 0.01) == (0.0, np.inf)
