"""Formulas against MuJoCo with the same law in its world."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from injected_parts import FORCE, LENGTH, SLAB, WEDGE, follow, lowest, make_scene, vector

from tpcd.effects import conditions
from tpcd.effects.catalogue import find_effect
from tpcd.effects.check import check_effect
from tpcd.effects.formula import formulas_over
from tpcd.effects.truth import EffectTruth, added_effects
from tpcd.truth.injected_world import STEP_LENGTH

SLIDES = ((0.02, 0.02, 0), (0.06, 0.02, 0), (0.03, 0.02, 0), (-0.02, 0.02, 0), (0.01, 0.0, 0))
PRESSED = (
    (0.02, 0.02, 0),
    (0.06, 0.0, 0),
    (0.09, -0.02, 0),
    (0.03, -0.02, 0),
    (-0.02, -0.03, 0.02),
)
RIPPLES = (
    {"floor_ripple": {"height": 0.0015, "length": 0.06}},
    {"floor_height ~ wave": {"sine": 0.0015, "length": 0.06}},
)
DENT = (
    {"floor_bump": {"height": -0.003, "x": 0.03}},
    {"floor_height ~ bump": {"height": -0.003, "place": 0.03, "width": 0.012}},
)
BUMP = (
    {"floor_bump": {"height": 0.003, "x": 0.03}},
    {"floor_height ~ bump": {"height": 0.003, "place": 0.03, "width": 0.012}},
)
Hidden = dict[str, dict[str, float]]


def modelled(
    hidden: Hidden, friction: float, commands=SLIDES, vertices: torch.Tensor = WEDGE
) -> np.ndarray:
    """Poses and readings (n, 6) of the model over the commands."""
    scene = make_scene(vertices, friction=friction)
    truth = EffectTruth(
        scene.vertices_ee,
        scene.friction,
        scene.floor_height,
        scene.wall_position,
        scene.stiffness,
        added_effects(hidden),
        len(commands),
    )
    truth.reset(scene.start_pose)
    return np.array([torch.cat(truth.step(vector(*command))[:2]).tolist() for command in commands])


def errors(
    law: tuple[Hidden, Hidden],
    friction: float,
    commands=PRESSED,
    vertices: torch.Tensor = WEDGE,
    points: int = 40,
) -> tuple[np.ndarray, np.ndarray]:
    """Largest errors of pose [m, m, rad], command by command, with the formula and without."""
    true = follow(law[0], *commands, vertices=vertices, friction=friction)[:, :3]
    close = subdivided(vertices, points)
    found = (modelled(hidden, friction, commands, close)[:, :3] for hidden in (law[1], {}))
    with_it, without = (np.abs(poses - true).max(axis=1) for poses in found)
    return with_it, without


def subdivided(vertices: torch.Tensor, count: int) -> torch.Tensor:
    """The outline with so many points on each side, as decoded ones have."""
    share = torch.arange(count, dtype=torch.float64)[:, None, None] / count
    sides = vertices + share * (vertices.roll(-1, 0) - vertices)
    return sides.transpose(0, 1).flatten(0, 1)


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


@pytest.mark.parametrize(
    ("law", "friction"), [(RIPPLES, 0.7), (DENT, 0.2), (DENT, 0.7), (BUMP, 0.2)]
)
def test_what_is_pressed_hard_slides_over_an_uneven_floor(
    law: tuple[Hidden, Hidden], friction: float
) -> None:
    with_it, without = errors(law, friction)
    assert with_it.max() < LENGTH
    assert without.max() > 5e-3


def test_looking_from_where_a_row_settles_makes_it_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the secant of the last two looks is what brings it to rest."""
    monkeypatch.setattr(conditions, "MOST_BACK", 0.0)
    with_it, _ = errors(RIPPLES, 0.7)
    assert with_it.max() > 1e-3


@pytest.mark.parametrize("friction", [0.7, 1.0])
def test_a_flat_face_spans_a_dent_and_lies_on_top_of_a_bump(friction: float) -> None:
    """Where it touches is between its corners, and the floor is steep beside it."""
    presses = ((0.03, 0.0, 0.0), (0.03, -0.02, 0.0))
    spans, _ = errors(DENT, friction, presses, SLAB, 200)
    on_top, without = errors(BUMP, friction, presses, SLAB, 200)
    assert max(spans.max(), on_top.max()) < 2 * LENGTH
    assert without.min() > 2.9e-3


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


def test_formulas_look_for_places_where_the_floor_was_touched() -> None:
    (step,) = (f for f in formulas_over(0.4, 0.7) if f.name == "floor_height ~ step")
    height, place = step.parameters
    assert (place.low, place.high, place.null) == pytest.approx((0.4, 0.7, 0.55))
    assert height == find_effect(step.name).parameters[0]
    check_effect(step)
