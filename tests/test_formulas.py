"""Formulas against MuJoCo with the same law in its world."""

from __future__ import annotations

import math

import numpy as np
import torch
from injected_parts import FORCE, LENGTH, WEDGE, follow, lowest, make_scene, vector

from tpcd.effects.truth import EffectTruth, added_effects
from tpcd.truth.injected_world import STEP_LENGTH

SLIDES = ((0.02, 0.02, 0), (0.06, 0.02, 0), (0.03, 0.02, 0), (-0.02, 0.02, 0), (0.01, 0.0, 0))


def modelled(hidden: dict[str, dict[str, float]], friction: float) -> np.ndarray:
    """Poses and readings (n, 6) of the model over `SLIDES`."""
    scene = make_scene(WEDGE, friction=friction)
    truth = EffectTruth(
        scene.vertices_ee,
        scene.friction,
        scene.floor_height,
        scene.wall_position,
        scene.stiffness,
        added_effects(hidden),
        len(SLIDES),
    )
    truth.reset(scene.start_pose)
    return np.array([torch.cat(truth.step(vector(*command))[:2]).tolist() for command in SLIDES])


def test_a_wave_is_a_rippled_floor() -> None:
    height, length = 0.001, 0.08
    ripple = {"floor_ripple": {"height": height, "length": length}}
    wave = {"floor_height ~ wave": {"sine": height, "length": length}}
    true = follow(ripple, *SLIDES, vertices=WEDGE, friction=0.2)
    ours = modelled(wave, 0.2)
    x, z = np.array([lowest(WEDGE, row) for row in ours]).T
    assert np.allclose(z, height * np.sin(2 * math.pi * x / length), atol=1e-6)
    assert np.ptp(z) > height
    assert np.allclose(ours[:, :2], true[:, :2], atol=5 * LENGTH)
    assert np.allclose(ours[:, 3:5], true[:, 3:5], atol=5 * FORCE)


def test_friction_by_place_is_a_field_of_friction() -> None:
    """Where exp(s x) and 1 + s x are close; the wedge slides to the right, then to the left."""
    slope = 1.5
    true = follow({"friction_field": {"slope": slope}}, *SLIDES, vertices=WEDGE, friction=0.2)
    ours = modelled({"log_friction ~ place": {"slope": slope}}, 0.2)
    plain = modelled({}, 0.2)
    assert np.allclose(ours[:, :2], true[:, :2], atol=LENGTH)
    assert np.abs(plain[:, :2] - true[:, :2]).max() > 10 * LENGTH


def test_a_step_is_a_step() -> None:
    step = {"height": 0.002, "x": 0.02}
    true = follow({"floor_step": step}, *SLIDES, vertices=WEDGE, friction=0.2)
    formula = {"floor_height ~ step": {"height": 0.002, "place": 0.02 + STEP_LENGTH / 2}}
    ours = modelled(formula, 0.2)
    assert np.allclose(ours[:, :2], true[:, :2], atol=5 * LENGTH)
    assert np.ptp(true[:, 1]) > 0.0015
