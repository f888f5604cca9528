"""The texture of outline errors is read off errors whose texture is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from training.evaluate import support_of
from training.fit import HULL_DIRECTIONS as DIRECTIONS
from training.misfit import measure_misfit
from training.texture import (
    GAP_NOISE,
    LEVER_NOISE,
    READINGS,
    RESOLUTION,
    TARGETS,
    Texture,
    draw_windows,
    score,
)

ANGLE = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)


def drawn(rng: np.random.Generator, sd: float, texture: Texture) -> np.ndarray:
    """A random error all around with the correlation of the model, and its slope."""
    apart = np.minimum(ANGLE, 2 * np.pi - ANGLE)
    spectrum = np.fft.fft(np.exp(-(apart**2) / (4 * texture.width**2))).real.clip(0)
    smooth = np.fft.ifft(np.sqrt(spectrum) * np.fft.fft(rng.standard_normal(DIRECTIONS))).real
    slope = np.gradient(np.concatenate((smooth[-2:], smooth, smooth[:2])), ANGLE[1])[2:-2]
    error = sd * (smooth + texture.grain * rng.standard_normal(DIRECTIONS))
    steep = sd * (slope + texture.roughness * rng.standard_normal(DIRECTIONS))
    return np.stack((error, steep))


@pytest.mark.parametrize("texture", [Texture(0.14, 0.15, 9.0), Texture(0.1, 0.02, 1.0)])
def test_the_texture_of_random_errors_is_found_and_predicts_them(texture: Texture) -> None:
    rng = np.random.default_rng(0)
    large = [drawn(rng, 6.0, texture) for _ in range(40)]
    small = [drawn(rng, 1.5, texture) for _ in range(40)]
    report = measure_misfit(large, small)
    found = report.misfit
    # Halfway between the logarithms of the two, and off by as much from both.
    assert found.sd == pytest.approx(3e-3, rel=0.05)
    assert found.spread == pytest.approx(np.log(2), abs=0.05)
    assert found.width == pytest.approx(texture.width, rel=0.1)
    assert found.grain == pytest.approx(texture.grain, rel=0.25)
    assert found.roughness == pytest.approx(texture.roughness, rel=0.25)
    # Small errors are held more often and large ones less, as the size is not known; in the mean
    # as often as it says.
    for name, share in report.held["unseen"].items():
        level = 0.9 if name.endswith("90%") else 0.5
        assert (share + report.held["known"][name]) / 2 == pytest.approx(level, abs=0.04), name


def test_groups_count_alike_whatever_their_sizes() -> None:
    rng = np.random.default_rng(1)
    smooth, rough = Texture(0.14, 0.02, 1.0), Texture(0.14, 0.3, 12.0)
    few = [drawn(rng, 3.0, smooth) for _ in range(10)]
    many = [drawn(rng, 3.0, rough) for _ in range(40)]
    even, odd = measure_misfit(few, many[:10]).misfit, measure_misfit(few, many).misfit
    assert odd.grain == pytest.approx(even.grain, rel=0.3)
    assert odd.roughness == pytest.approx(even.roughness, rel=0.3)


def test_nothing_is_measured_without_outlines_of_both_kinds() -> None:
    error = np.ones((2, DIRECTIONS))
    with pytest.raises(ValueError, match="got 1 unseen and 0 training outlines"):
        measure_misfit([error], [])


def test_predictions_of_errors_are_those_of_the_joint_normal_distribution() -> None:
    """One size: density and distribution function by conditioning all numbers at once."""
    texture, sd = Texture(0.15, 0.1, 3.0), 2.0
    windows = draw_windows(
        [[drawn(np.random.default_rng(2), sd, texture)]], np.random.default_rng(3)
    )
    log_density, below = score(windows, texture, sd * np.hypot(1, texture.grain), 1e-9)
    angles, read, wanted = windows.angles[0], windows.read[0], windows.wanted[0]
    both = torch.cat((angles, angles)).requires_grad_()
    n = READINGS + TARGETS

    def kernel(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return sd**2 * torch.exp(-((a - b) ** 2) / (4 * texture.width**2))

    # Slopes by automatic differentiation of the kernel, in one and in both of its arguments.
    first = torch.func.grad(kernel, argnums=0)
    second = torch.func.grad(kernel, argnums=1)
    mixed = torch.func.grad(first, argnums=1)
    joint = torch.empty(2 * n, 2 * n, dtype=torch.float64)
    for i in range(2 * n):
        for j in range(2 * n):
            function = ((kernel, second), (first, mixed))[i // n][j // n]
            joint[i, j] = function(both[i].detach(), both[j].detach())
    own = torch.tensor((texture.grain, texture.roughness), dtype=torch.float64) * sd
    joint += torch.diag((own**2).repeat_interleave(n))
    seen = torch.cat((torch.arange(READINGS), n + torch.arange(READINGS)))
    noise = torch.tensor((GAP_NOISE, LEVER_NOISE), dtype=torch.float64).repeat_interleave(READINGS)
    noisy = joint[seen[:, None], seen] + torch.diag(noise**2)
    others = torch.cat((torch.arange(READINGS, n), n + torch.arange(READINGS, n)))
    for place, index in enumerate(others):
        gain = torch.linalg.solve(noisy, joint[seen, index])
        variance = joint[index, index] - gain @ joint[seen, index] + RESOLUTION**2
        alone = Normal(gain @ read, variance.sqrt())
        assert float(log_density[0, place]) == pytest.approx(
            float(alone.log_prob(wanted[place])), abs=1e-5
        )
        assert float(below[0, place]) == pytest.approx(float(alone.cdf(wanted[place])), abs=1e-6)


def test_the_size_is_learnt_from_the_readings() -> None:
    """Errors of log-normal sizes: held as often as they should where that is what is believed."""
    rng = np.random.default_rng(4)
    texture = Texture(0.15, 0.1, 3.0)
    sizes = np.exp(rng.standard_normal(120)) / np.hypot(1, texture.grain)
    windows = draw_windows([[drawn(rng, size, texture) for size in sizes]], rng)
    _, learnt = score(windows, texture, 1.0, 1.0)
    _, given = score(windows, texture, 1.0, 1e-9)
    inside = [float(((p > 0.05) & (p < 0.95)).double().mean()) for p in (learnt, given)]
    assert inside[0] == pytest.approx(0.9, abs=0.02)
    assert inside[1] < 0.85


def test_slopes_are_derivatives_of_the_support_function() -> None:
    polygon = np.array([[0.05, 0.02], [-0.04, 0.03], [-0.05, -0.02], [0.04, -0.03]])
    value, slope = support_of(polygon, DIRECTIONS)
    smooth = np.abs(np.diff(slope, append=slope[0])) < 1e-3
    smooth &= np.roll(smooth, 1)
    difference = (np.roll(value, -1) - np.roll(value, 1)) / (2 * ANGLE[1])
    assert smooth.sum() > 0.9 * len(value)
    np.testing.assert_allclose(slope[smooth], difference[smooth], atol=1e-6)
