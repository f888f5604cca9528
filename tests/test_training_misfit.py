"""The texture of outline errors is read off errors whose texture is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from training.evaluate import support_of
from training.fit import HULL_DIRECTIONS as DIRECTIONS
from training.fit import Fit
from training.misfit import fit_variogram, measure_misfit, variogram

ANGLE = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)


def drawn(rng: np.random.Generator, sd: float, width: float, grain: float, rough: float) -> Fit:
    """A random error all around with the correlation of the model, and its slope."""
    apart = np.abs(ANGLE[:, None] - ANGLE)
    apart = np.minimum(apart, 2 * np.pi - apart)
    spectrum = np.fft.fft(np.exp(-(apart[0] ** 2) / (4 * width**2))).real.clip(0)
    smooth = np.fft.ifft(np.sqrt(spectrum) * np.fft.fft(rng.standard_normal(DIRECTIONS))).real
    slope = np.gradient(np.concatenate((smooth[-2:], smooth, smooth[:2])), ANGLE[1])[2:-2]
    error = sd * (smooth + grain * rng.standard_normal(DIRECTIONS))
    steep = sd * (slope + rough * rng.standard_normal(DIRECTIONS))
    return Fit(torch.zeros(2), np.zeros(3), error, steep)


@pytest.mark.parametrize("texture", [(0.14, 0.15, 9.0), (0.22, 0.0, 2.0), (0.1, 0.3, 0.0)])
def test_the_texture_of_random_errors_is_found(texture: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    width, grain, rough = texture
    unseen = [drawn(rng, 0.5, *texture) for _ in range(60)]
    known = [0.05 * np.ones(7), 0.05 * np.ones(7)]
    found = measure_misfit(unseen, known)
    # Halfway between the logarithms of the unseen and of the known, and off by as much from both.
    assert found.sd == pytest.approx(0.00158 * 0.1, rel=0.1)
    assert found.spread == pytest.approx(np.log(10) / 2, abs=0.1)
    assert found.width == pytest.approx(width, rel=0.1)
    assert found.grain == pytest.approx(grain, abs=0.05)
    assert found.roughness == pytest.approx(rough, abs=1.0)


def test_a_variogram_of_the_model_is_fitted_exactly() -> None:
    lags = np.linspace(0.03, 0.45, 50)
    width, grain = fit_variogram(lags, 1 - np.exp(-(lags**2) / (4 * 0.17**2)) / 1.04)
    assert (width, grain) == (pytest.approx(0.17, rel=1e-4), pytest.approx(0.2, rel=1e-4))


def test_errors_without_a_memory_differ_by_twice_their_square() -> None:
    error = np.random.default_rng(1).standard_normal(200_000)
    assert variogram(error)[1] == pytest.approx(np.ones_like(variogram(error)[1]), abs=0.02)


def test_slopes_are_derivatives_of_the_support_function() -> None:
    polygon = np.array([[0.05, 0.02], [-0.04, 0.03], [-0.05, -0.02], [0.04, -0.03]])
    value, slope = support_of(polygon, DIRECTIONS)
    smooth = np.abs(np.diff(slope, append=slope[0])) < 1e-3
    smooth &= np.roll(smooth, 1)
    difference = (np.roll(value, -1) - np.roll(value, 1)) / (2 * ANGLE[1])
    assert smooth.sum() > 0.9 * len(value)
    np.testing.assert_allclose(slope[smooth], difference[smooth], atol=1e-6)
