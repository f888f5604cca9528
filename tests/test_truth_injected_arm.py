"""Arm, sensor and grasp with effects injected into MuJoCo, each against a closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from injected_parts import FORCE, HOOK, LENGTH, NOMINAL, PRESS_1, follow, lowest, make_scene, vector

from tpcd.truth.injected import InjectedMujocoTruth
from tpcd.truth.injected_effects import FORMS
from tpcd.truth.mujoco_scene import MujocoSettings


def test_the_true_stiffness_makes_the_forces():
    hidden = {"stiffness_error": {"log_ratio_x": 0.1, "log_ratio_z": -0.08}}
    free, pressed, slid = follow(hidden, (0.01, 0.05, 0), (0.01, 0.0, 0), (0.018, 0.0, 0))
    assert free == pytest.approx([0.01, 0.05, 0, 0, 0, 0], abs=1e-3)
    assert pressed[4] == pytest.approx(3.0 * math.exp(-0.08), abs=FORCE)
    assert slid[3] == pytest.approx(-0.8 * math.exp(0.1), abs=FORCE)


def test_a_payload_makes_the_free_arm_sag_and_turn():
    hidden = {"payload": {"weight": 1.2, "lever": 0.05}}
    free, pressed = follow(hidden, (0.0, 0.08, 0.1), (0, -0.02, 0))
    torque = -1.2 * 0.05 * math.cos(free[2])
    assert free[3:] == pytest.approx([0.0, -1.2, torque], abs=FORCE)
    assert free[:3] == pytest.approx([0.0, 0.08 - 0.012, 0.1 + torque / 50], abs=LENGTH)
    assert pressed[[1, 4]] == pytest.approx([0.03, 5.0], abs=FORCE)


def test_a_lagging_controller_stops_a_share_of_the_last_step_short():
    first, second, pause = follow(
        {"command_lag": {"share": 0.2}}, (0.01, 0.07, 0.1), (0.03, 0.05, -0.1), (0.03, 0.05, -0.1)
    )
    assert first == pytest.approx([0.008, 0.068, 0.08, 0, 0, 0], abs=1e-3)
    assert second == pytest.approx([0.026, 0.054, -0.06, 0, 0, 0], abs=1e-3)
    assert pause == pytest.approx([0.03, 0.05, -0.1, 0, 0, 0], abs=1e-3)


def test_dry_friction_of_the_arm_stops_it_short_and_is_not_measured():
    hidden = {"arm_friction": {"force": 0.3}}
    commands = ((0.02, 0.06, 0), (0.02, 0.06, 0), (-0.02, 0.08, 0), (-0.02, -0.02, 0))
    right, pause, left, _ = follow(hidden, *commands)
    assert right == pytest.approx([0.017, 0.06, 0, 0, 0, 0], abs=1e-4)
    assert pause == pytest.approx(right, abs=2e-5)
    assert left == pytest.approx([-0.017, 0.077, 0, 0, 0, 0], abs=1e-4)
    # Pressed at 4 mm/s or slower, 6 to 7 mN are missing of the friction; from 8 mm/s on, none.
    fast = MujocoSettings(ramp_speed=(math.inf, math.inf))
    pressed = follow(hidden, *commands, settings=fast)[-1]
    assert pressed[[1, 4]] == pytest.approx([0.03, 4.7], abs=FORCE)


def test_a_compliant_grasp_turns_by_compliance_times_torque():
    rows = follow(
        {"grasp_compliance": {"compliance": 0.1}}, (0, 0.02, 0), (0, -0.01, 0), vertices=HOOK
    )
    for row in rows:
        corner = lowest(HOOK, row, turn=0.1 * row[5])
        assert corner[1] == pytest.approx(0.0, abs=LENGTH)
        arm = corner - row[:2]
        assert row[5] == pytest.approx(arm[0] * row[4] - arm[1] * row[3], abs=1e-3)
        assert abs(lowest(HOOK, row)[1]) > 4e-4


def test_the_grasp_slips_at_its_row_and_not_before():
    hidden = {"grasp_slip": {"angle": 0.03, "shift": 0.002, "at": 0.5}}
    press = (0.0, 0.02, 0.0)
    rows = follow(hidden, *[press] * 4, vertices=HOOK)
    assert lowest(HOOK, rows[0])[1] == pytest.approx(0.0, abs=LENGTH)
    for row in rows[1:]:
        corner = lowest(HOOK, row, turn=0.03, shift=0.002)
        assert corner[1] == pytest.approx(0.0, abs=LENGTH)
        arm = corner - row[:2]
        assert row[5] == pytest.approx(arm[0] * row[4] - arm[1] * row[3], abs=1e-3)


def test_the_floor_drifts_with_the_row():
    rows = follow({"floor_drift": {"drift": 0.003}}, *[PRESS_1] * 4, floor=-0.01, steps=5)
    assert np.allclose(rows[:, 1], 0.02 + 0.003 * np.arange(1, 5) / 5, atol=LENGTH)


def test_several_effects_act_together():
    rows = follow(
        {
            "floor_compliance": {"compliance": 2e-4},
            "stiffness_error": {"log_ratio_z": 0.1},
            "floor_drift": {"drift": 0.004},
            "directional_friction": {"log_ratio": 0.2},
        },
        (0, -0.02, 0), (0.07, -0.02, 0),
    )  # fmt: skip
    stiffness = 100 * math.exp(0.1)
    for row, height in zip(rows, (0.002, 0.004), strict=True):
        load = stiffness * (0.05 + height) / (1 + stiffness * 2e-4)
        assert row[4] == pytest.approx(load, abs=FORCE)
        assert row[1] == pytest.approx(0.03 + height - 2e-4 * load, abs=LENGTH)
    assert rows[1, 3] / rows[1, 4] == pytest.approx(-NOMINAL * math.exp(0.2), abs=2e-3)


def test_the_truth_reports_what_its_sensor_does():
    hidden = {"force_gain": {"gain": 0.1}, "force_drift": {"F_z": 1.0}}
    truth = InjectedMujocoTruth(make_scene(), hidden, 4)
    for row in range(1, 4):
        _, wrench, _ = truth.step(vector(*PRESS_1))
        assert float(wrench[1]) == pytest.approx(2.0 * 1.1 + row / 4, abs=FORCE)


def test_an_episode_has_at_least_one_step():
    with pytest.raises(ValueError, match="steps is 0"):
        InjectedMujocoTruth(make_scene(), {}, 0)


def test_every_effect_of_the_catalogue_settles_in_contact_with_floor_and_wall():
    sizes = {"curvature": 0.5, "ratio": 1.4, "compliance": 2e-4, "force": 0.3, "height": 0.002}
    sizes |= {"shift": 0.002, "angle": 0.03}
    corner = ((0.07, 0.02, 0.0), (0.12, 0.02, 0.0), (0.12, 0.06, 0.1), (0.12, 0.01, -0.1))
    for name, form in FORMS.items():
        hidden = {name: {size: sizes.get(size, 0.05) for size in form.sizes}}
        scene = make_scene(HOOK, wall=0.12)
        truth = InjectedMujocoTruth(scene, hidden, len(corner))
        for command in corner:
            pose, wrench, settled = truth.step(vector(*command))
            assert settled, name
            assert bool(torch.isfinite(pose).all() and torch.isfinite(wrench).all())
