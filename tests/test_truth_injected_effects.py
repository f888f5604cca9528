"""Names and parameters of injected effects, and what wrong sensors report."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.truth.injected import sensor_effects
from tpcd.truth.injected_effects import FORMS, WORLD_EFFECTS, active_effects


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        ({}, (2.0, 4.0, 0.3)),
        ({"force_bias": {"F_x": 0.6, "F_z": -0.9, "tau": 0.03}}, (2.6, 3.1, 0.33)),
        ({"force_drift": {"F_x": 1.0, "F_z": -1.2}}, (2.5, 3.4, 0.3)),
        ({"force_gain": {"gain": 0.1}}, (2.2, 4.4, 0.33)),
        ({"sensor_rotation": {"angle": math.pi / 2}}, (-4.0, 2.0, 0.3)),
        (
            {"wrench_reference_point": {"x": 0.01, "z": 0.02}},
            (2.0, 4.0, 0.3 - (0.01 * 4.0 - 0.02 * 2.0)),
        ),
        (
            {"sensor_rotation": {"angle": math.pi / 2}, "force_bias": {"F_x": 1.0}},
            (-3.0, 2.0, 0.3),
        ),
    ],
)
def test_a_wrong_sensor_reports(hidden, expected):
    pose, wrench = vector(0.1, 0.2, 0.3), vector(2.0, 4.0, 0.3)
    reported = sensor_effects(hidden, pose, wrench, 0.5)
    assert torch.equal(reported[0], pose)
    assert reported[1].tolist() == pytest.approx(expected)
    assert wrench.tolist() == [2.0, 4.0, 0.3]


@pytest.mark.parametrize(
    ("hidden", "message"),
    [
        ({"flor_tilt": {"angle": 0.1}}, "unknown effect 'flor_tilt', known are floor_compliance"),
        ({"floor_tilt": {"slope": 0.1}}, "floor_tilt has no parameter 'slope', expected angle"),
        ({"adhesion": {"force": -1.0}}, "force of adhesion is -1.0, expected finite, >= 0"),
        ({"static_kinetic": {"ratio": 0.5}}, "expected finite, >= 1"),
        ({"payload": {"weight": math.nan}}, "weight of payload is nan"),
    ],
)
def test_what_has_no_meaning_is_refused_in_one_line(hidden, message):
    with pytest.raises(ValueError, match=message) as raised:
        active_effects(hidden)
    assert "\n" not in str(raised.value)


def test_what_is_left_out_is_null_and_null_effects_are_absent():
    given = {
        "force_bias": {"F_z": -1},
        "payload": {"weight": 0.0, "lever": 0.1},
        "static_kinetic": {"ratio": 1.0},
        "grasp_slip": {"at": 0.5},
        "command_lag": {},
    }
    effects = active_effects(given)
    assert effects.values == {"force_bias": {"F_x": 0.0, "F_z": -1.0, "tau": 0.0}}
    assert effects.get("static_kinetic", "ratio") == 1.0 and "payload" not in effects
    assert set(WORLD_EFFECTS) < set(FORMS)
