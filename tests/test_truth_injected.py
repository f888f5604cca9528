"""Surfaces with effects injected into MuJoCo, each against a closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from injected_parts import (
    FORCE,
    HOOK,
    LENGTH,
    NOMINAL,
    PRESS_1,
    PRESS_2,
    TOWER,
    WEDGE,
    follow,
    lowest,
    make_scene,
    random_commands,
    vector,
)

from tpcd.truth.injected import InjectedMujocoTruth
from tpcd.truth.injected_world import FloorShape
from tpcd.truth.mujoco_truth import MujocoTruth
from tpcd.truth.protocol import Truth

NULLS = {
    "floor_tilt": {"angle": 0.0},
    "static_kinetic": {"ratio": 1.0},
    "grasp_slip": {"angle": 0.0, "shift": 0.0, "at": 0.5},
    "payload": {"weight": 0.0, "lever": 0.1},
    "command_lag": {"share": 0.0},
    "force_gain": {},
}


@pytest.mark.parametrize("hidden", [{}, NULLS])
def test_without_effects_the_answers_are_those_of_the_undisturbed_truth(hidden):
    scene = make_scene(HOOK, wall=0.1)
    injected = InjectedMujocoTruth(scene, hidden, 6)
    plain = MujocoTruth(
        scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position, scene.stiffness
    )
    plain.reset(scene.start_pose)
    assert isinstance(injected, Truth)
    for command in random_commands(0):
        ours, theirs = injected.step(vector(*command)), plain.step(vector(*command))
        assert torch.equal(ours[0], theirs[0]) and torch.equal(ours[1], theirs[1])


@pytest.mark.parametrize(
    "tiny",
    [
        {"floor_tilt": {"angle": 1e-9}},
        {"floor_curvature": {"curvature": -1e-9}},
        {"floor_compliance": {"compliance": 1e-8}, "wall_compliance": {"compliance": 1e-8}},
        {"grasp_compliance": {"compliance": 1e-5}},
        {"directional_friction": {"log_ratio": 1e-9}, "friction_field": {"slope": 1e-9}},
        {"load_friction": {"exponent": 1e-9}, "static_kinetic": {"ratio": 1 + 1e-9}},
        {"adhesion": {"force": 1e-6}},
        {"grasp_slip": {"angle": 1e-9}, "floor_drift": {"drift": 1e-9}},
        {"payload": {"weight": 1e-9}},
        {"arm_friction": {"force": 1e-4}},
    ],
)
def test_the_changed_world_with_a_tiny_effect_is_the_undisturbed_one(tiny):
    commands = random_commands(1, 4)
    scene = {"vertices": HOOK, "wall": 0.1}
    assert np.allclose(follow(tiny, *commands, **scene), follow({}, *commands, **scene), atol=2e-3)


def test_reset_starts_the_same_episode_again():
    hidden = {
        "static_kinetic": {"ratio": 1.4},
        "floor_drift": {"drift": 0.003},
        "grasp_slip": {"angle": 0.02, "at": 0.5},
        "adhesion": {"force": 0.5},
    }
    truth = InjectedMujocoTruth(make_scene(HOOK), hidden, 4)
    runs = []
    for _ in range(2):
        truth.reset(vector(0.0, 0.06, 0.0))
        runs.append(torch.cat([torch.cat(truth.step(vector(*c))[:2]) for c in random_commands(2)]))
    assert torch.equal(*runs)


def test_a_compliant_floor_sinks_by_compliance_times_load():
    rows = follow({"floor_compliance": {"compliance": 2.5e-4}}, PRESS_1, PRESS_2, PRESS_1)
    assert np.allclose(rows[:, 1], 0.03 - 2.5e-4 * rows[:, 4], atol=LENGTH)
    assert rows[1, 4] == pytest.approx(6.0 / 1.025, abs=FORCE)


def test_a_compliant_wall_gives_way_by_compliance_times_load():
    press = [(0.10 + depth, 0.1, 0.0) for depth in (0.02, 0.05)]
    rows = follow({"wall_compliance": {"compliance": 2.5e-4}}, *press, vertices=TOWER, wall=0.13)
    assert np.allclose(rows[:, 0], 0.10 - 2.5e-4 * rows[:, 3], atol=LENGTH)
    assert rows[1, 3] == pytest.approx(-5.0 / 1.025, abs=FORCE)


def test_both_surfaces_give_way_along_their_tangent():
    hidden = {"tangential_compliance": {"compliance": 5e-4}}
    rows = follow(hidden, (0, -0.02, 0), (0.015, -0.02, 0))
    assert rows[1, 3] == pytest.approx(-1.5 / 1.05, abs=FORCE)
    assert rows[1, 0] == pytest.approx(5e-4 * 1.5 / 1.05, abs=LENGTH)
    rows = follow(hidden, (0.15, 0.06, 0), (0.15, 0.075, 0), vertices=TOWER, wall=0.13)
    assert rows[1, 1] == pytest.approx(0.06 + 5e-4 * 1.5 / 1.05, abs=LENGTH)


def test_a_tilted_floor_rises_towards_x():
    angle = 0.025
    rows = follow(
        {"floor_tilt": {"angle": angle}},
        (0, 0.03, 0), (0.06, 0.03, 0), (-0.06, 0.03, 0),
        vertices=WEDGE, friction=0.3, floor=0.01, start=(0, 0.08, 0),
    )  # fmt: skip
    points = np.array([lowest(WEDGE, row) for row in rows])
    assert np.ptp(points[:, 0]) > 0.06
    assert np.allclose(points[:, 1] - 0.01, points[:, 0] * math.tan(angle), atol=LENGTH)
    # Friction relative to the tilted normal, sliding right.
    along = rows[1, 3] * math.cos(angle) + rows[1, 4] * math.sin(angle)
    across = -rows[1, 3] * math.sin(angle) + rows[1, 4] * math.cos(angle)
    assert along / across == pytest.approx(-0.3, abs=2e-3)


def test_a_tilted_wall_leans_left_as_it_rises():
    angle = 0.05
    spike = vector(0.05, 0.0, -0.04, 0.04, -0.04, -0.04).reshape(3, 2)
    rows = follow(
        {"wall_tilt": {"angle": angle}}, (0.13, 0.15, 0), (0.13, 0.20, 0), vertices=spike, wall=0.15
    )
    tips = [row[:2] + 0.05 * np.array([math.cos(row[2]), math.sin(row[2])]) for row in rows]
    assert tips[1][1] - tips[0][1] > 0.01
    for tip in tips:
        assert tip[0] == pytest.approx(0.15 - tip[1] * math.tan(angle), abs=LENGTH)


@pytest.mark.parametrize("curvature", [1.5, -1.5])
def test_the_height_of_a_curved_floor_is_half_curvature_times_x_squared(curvature):
    rows = follow(
        {"floor_curvature": {"curvature": curvature}},
        (0, 0.02, 0), (0.08, 0.02, 0), (-0.08, 0.02, 0), vertices=WEDGE,
    )  # fmt: skip
    points = np.array([lowest(WEDGE, row) for row in rows])
    assert np.abs(points[1:, 0]).min() > 0.04
    assert np.allclose(points[:, 1], curvature * points[:, 0] ** 2 / 2, atol=LENGTH)


def test_a_flat_object_rests_on_the_top_of_a_hill_and_spans_a_hollow():
    hill, hollow = (
        follow({"floor_curvature": {"curvature": curvature}}, PRESS_1)[0] for curvature in (-2, 2)
    )
    assert hill[1] == pytest.approx(0.03, abs=LENGTH)
    assert hollow[1] == pytest.approx(0.03 + 0.05**2, abs=LENGTH)


def test_a_step_in_the_floor_lifts_what_passes_it():
    rows = follow(
        {"floor_step": {"height": 0.002, "x": 0.02}},
        (0, 0.03, 0), (0.06, 0.03, 0), (-0.04, 0.03, 0), vertices=WEDGE, friction=0.2,
    )  # fmt: skip
    heights = [lowest(WEDGE, row)[1] for row in rows]
    assert np.allclose(heights, [0.0, 0.002, 0.0], atol=LENGTH)


@pytest.mark.parametrize("skew", [0.0, 0.25])
def test_a_rippled_floor_lifts_by_its_waves(skew: float):
    rows = follow(
        {"floor_ripple": {"height": 0.001, "length": 0.08, "skew": skew}},
        (0.02, 0.03, 0), (0.06, 0.03, 0), (-0.02, 0.03, 0), vertices=WEDGE, friction=0.2,
    )  # fmt: skip
    x, heights = np.array([lowest(WEDGE, row) for row in rows]).T
    wave = 2 * np.pi * x / 0.08
    assert np.ptp(heights) > 0.0015
    assert np.allclose(heights, 0.001 * (np.sin(wave) + skew * np.sin(2 * wave)), atol=5 * LENGTH)


@pytest.mark.parametrize("skew", [0.0, 0.4])
@pytest.mark.parametrize("height", [0.002, -0.002])
def test_a_bump_lifts_what_passes_it_and_a_dent_lets_it_sink(height: float, skew: float):
    rows = follow(
        {"floor_bump": {"height": height, "x": 0.02, "skew": skew}},
        (0, 0.03, 0), (0.02, 0.03, 0), (0.06, 0.03, 0), (0.03, 0.03, 0),
        vertices=WEDGE, friction=0.2,
    )  # fmt: skip
    x, heights = np.array([lowest(WEDGE, row) for row in rows]).T
    width = 0.012 * np.where(x > 0.02, 1 + skew, 1 - skew)
    assert np.ptp(heights) > 0.001
    assert np.allclose(heights, height * np.exp(-0.5 * ((x - 0.02) / width) ** 2), atol=5 * LENGTH)


def test_the_rise_of_a_floor_is_the_slope_of_its_height():
    shape = FloorShape(0.02, 0.5, 2e-3, 0.01, 1e-3, 0.07, 0.25, 3e-3, 0.03, 0.4)
    x = np.linspace(-0.05, 0.1, 311)
    slope = (shape.height(x + 1e-7) - shape.height(x - 1e-7)) / 2e-7
    assert np.allclose(np.tan(shape.rise(x)), slope, atol=3e-5)


def slide_ratios(hidden, depth=0.05, **scene) -> list[float]:
    """F_t / F_n on the floor after sliding right and left."""
    z = 0.03 - depth
    rows = follow(hidden, (0, z, 0), (0.07, z, 0), (-0.07, z, 0), **scene)
    return (rows[1:, 3] / rows[1:, 4]).tolist()


def wall_ratios(hidden) -> list[float]:
    """F_t / F_n on the wall after sliding up and down."""
    rows = follow(
        hidden, (0.13, 0.15, 0), (0.13, 0.20, 0), (0.13, 0.10, 0), vertices=TOWER, wall=0.13
    )
    return (-rows[1:, 4] / rows[1:, 3]).tolist()


def test_the_wall_has_a_friction_of_its_own():
    hidden = {"wall_friction": {"log_ratio": -0.6}}
    assert slide_ratios(hidden) == pytest.approx([-NOMINAL, NOMINAL], abs=2e-3)
    own = NOMINAL * math.exp(-0.6)
    assert wall_ratios(hidden) == pytest.approx([-own, own], abs=2e-3)


def test_friction_depends_on_the_direction_of_the_slide():
    hidden = {"directional_friction": {"log_ratio": 0.3}}
    more, less = NOMINAL * math.exp(0.3), NOMINAL * math.exp(-0.3)
    assert slide_ratios(hidden) == pytest.approx([-more, less], abs=2e-3)
    assert wall_ratios(hidden) == pytest.approx([-more, less], abs=2e-3)


def test_static_friction_holds_more_than_a_slide_and_returns_after_rest():
    hidden = {"static_kinetic": {"ratio": 1.5}}
    hold = (0.028, -0.02, 0)  # 2.8 N at a load of 5 N: within 0.6, beyond 0.4
    rows = follow(hidden, (0, -0.02, 0), hold, (0.06, -0.02, 0), (0.068, -0.02, 0))
    assert abs(rows[1, 0]) < LENGTH and rows[1, 3] == pytest.approx(-2.8, abs=FORCE)
    assert rows[2, 3:5] == pytest.approx([-2.0, 5.0], abs=2 * FORCE)
    assert rows[3, 0] == pytest.approx(rows[2, 0], abs=LENGTH)
    assert rows[3, 3] == pytest.approx(-2.8, abs=2 * FORCE)


def test_friction_is_a_power_of_the_load():
    hidden = {"load_friction": {"exponent": -0.3}}
    for depth in (0.015, 0.03, 0.06):
        expected = NOMINAL * (depth * 100 / 3) ** -0.3
        assert slide_ratios(hidden, depth) == pytest.approx([-expected, expected], abs=4e-3)


def test_friction_varies_along_the_floor():
    rows = follow(
        {"friction_field": {"slope": 4.0}},
        (0, 0.02, 0), (0.08, 0.02, 0), (-0.08, 0.02, 0), vertices=WEDGE,
    )  # fmt: skip
    for row, sign in zip(rows[1:], (-1, 1), strict=True):
        expected = sign * NOMINAL * (1 + 4.0 * lowest(WEDGE, row)[0])
        assert row[3] / row[4] == pytest.approx(expected, abs=2e-3)


def test_adhesion_holds_until_it_is_pulled_harder():
    rows = follow({"adhesion": {"force": 1.0}}, PRESS_1, (0, 0.039, 0), (0, 0.042, 0), PRESS_1)
    assert rows[[0, 3], 1] == pytest.approx(0.03, abs=LENGTH)
    assert rows[[0, 3], 4] == pytest.approx(2.0, abs=FORCE)
    assert rows[1, [1, 4]] == pytest.approx([0.03, -0.9], abs=FORCE)
    assert rows[2, [1, 4]] == pytest.approx([0.042, 0.0], abs=FORCE)


def test_adhesion_adds_to_the_compression_that_friction_sees():
    rows = follow({"adhesion": {"force": 1.0}}, (0, -0.02, 0), (0.06, -0.02, 0))
    assert rows[1, 3:5] == pytest.approx([-NOMINAL * 6.0, 5.0], abs=FORCE)
