"""Checks in free air, and the noise that is measured there."""

from __future__ import annotations

import numpy as np
import pytest

from tpcd.errors import RobotError
from tpcd.robot.preflight import (
    ARM,
    GRAVITY,
    FreeAir,
    check_before_zeroing,
    check_drift,
    check_payload,
    check_tilted,
    check_zeroed,
    mean_noise,
    reading_noise,
    row_noise,
)
from tpcd.robot.settling import SettlingSettings

RATE, NOISE = 125.0, np.array([0.2, 0.2, 0.01])


def air(
    force: tuple[float, float] = (0.0, 0.0),
    drift: float = 0.0,
    angle: float = 0.0,
    seconds: float = 3.0,
    seed: int = 0,
) -> FreeAir:
    generator = np.random.default_rng(seed)
    stamps = np.arange(int(seconds * RATE)) / RATE
    wrenches = NOISE * generator.standard_normal((len(stamps), 3))
    wrenches[:, :2] += force
    wrenches[:, 1] += drift * stamps
    poses = np.array([0.0, 0.1, angle]) + 1e-5 * generator.standard_normal((len(stamps), 3))
    return FreeAir(stamps, poses, wrenches)


def test_a_sound_sensor_passes() -> None:
    check_payload(0.5, 0.52)
    check_payload(None, 3.0)
    check_before_zeroing(air((3.0, -6.0)))
    check_zeroed(air(drift=0.1))
    check_drift(air(drift=0.1))
    assert check_tilted(air(angle=-0.1), air(angle=0.1, seed=1)) < 0.05


def test_what_is_wrong_is_named_with_its_size() -> None:
    with pytest.raises(RobotError, match="payload of 0.50 kg, expected 1.20 kg"):
        check_payload(1.2, 0.5)
    with pytest.raises(RobotError, match="14.* N before zeroing"):
        check_before_zeroing(air((0.0, -14.7)))
    with pytest.raises(RobotError, match="2.5. N, .* right after zeroing, expected at most"):
        check_zeroed(air((0.0, 2.5)))
    with pytest.raises(RobotError, match="drifts by 0.4. N/s"):
        check_drift(air(drift=0.45))


def test_a_wrong_payload_shows_when_the_tool_tilts() -> None:
    """What was zeroed turns with the sensor, weight does not: m g times the angle."""
    turned = 0.5 * GRAVITY * 0.1
    left, right = air((-turned, 0.0), angle=-0.1), air((turned, 0.0), angle=0.1, seed=1)
    with pytest.raises(RobotError, match=r"wrong by about 0\.(4|5)\d kg"):
        check_tilted(left, right)
    small = 0.1 * turned
    slight = air((-small, 0.0), angle=-0.1), air((small, 0.0), angle=0.1, seed=1)
    assert check_tilted(*slight) == pytest.approx(small, abs=0.03)


def test_the_noise_of_a_mean_is_that_of_independent_readings() -> None:
    """200 recordings; slow noise is seen by chance in 1 % of 600 channels."""
    found = [mean_noise(air(seed=seed), 0.6) for seed in range(200)]
    expected = NOISE / np.sqrt(0.6 * RATE)
    np.testing.assert_allclose(np.mean([fast for fast, _ in found], axis=0)[3:], expected, 0.03)
    assert np.mean([slow[3:] > 0 for _, slow in found]) < 0.03
    np.testing.assert_allclose(reading_noise(air(seconds=20.0)), NOISE, rtol=0.06)


def test_slow_noise_is_told_apart() -> None:
    still = air(seconds=6.0)
    wave = 0.3 * np.sin(2 * np.pi * still.stamps / 2.5)
    swaying = FreeAir(still.stamps, still.poses, still.wrenches + wave[:, None])
    fast, slow = mean_noise(swaying, 0.6)
    assert 0.15 < slow[3] < 0.3
    np.testing.assert_allclose(fast[3:], NOISE / np.sqrt(0.6 * RATE), rtol=0.1)


def test_a_row_has_the_noise_of_a_window_s_mean_and_turns_it_into_motion() -> None:
    """0.6 s of independent readings, a quarter of what may be left, half of what turning left, and
    what an arm does not know of its pose."""
    stiffness, count = np.array([100.0, 100.0, 50.0]), 0.6 * RATE
    left = 0.25 * np.array(SettlingSettings().residual)
    expected = np.sqrt(NOISE**2 / count + left**2)
    found = row_noise(air(seconds=30.0), 0.0, SettlingSettings(), stiffness)
    np.testing.assert_allclose(found[3:], expected, rtol=0.05)
    np.testing.assert_allclose(found[:3], np.hypot(expected / stiffness, ARM), rtol=0.05)
    turned = row_noise(air(seconds=30.0), 0.4, SettlingSettings(), stiffness)
    np.testing.assert_allclose(turned[3:5], np.hypot(expected[:2], 0.2), rtol=0.05)
    assert turned[5] == found[5]
