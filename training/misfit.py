"""How outlines differ from their best fits, as contact feels it: `tpcd.shape.protocol.Misfit`.

Whether the object in the hand is one that the prior knows, nobody tells. So the size of the misfit
is that of training outlines and of unseen ones, in equal shares: logarithms of the two have their
common mean and standard deviation. Its texture is that of unseen ones.

The difference e of two support functions is a function of the angle. Half the mean square of
e(a + d) - e(a), over its mean square, is the variogram of the outline. Its median over outlines is
fitted with what the model of the estimator says (`tpcd.belief.misfit`),

    V(d) = 1 - s exp(-d^2 / (4 width^2)),    s = 1 / (1 + grain^2)  the share of the smooth part,

over the angles between two readings that matter most: from `NEAREST`, since grain is new at each
reading, to `FURTHEST`, where the smooth part has forgotten most. Relative to that of the smooth
part, the mean square of its slope is 1 / (2 width^2); what the slope of e has more is roughness.
Where a nearly flat face touches, e hardly changes while contact jumps from one end to the other,
so slopes are far larger than a smooth function of the size of e would have.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares

from tpcd.shape.protocol import Misfit
from training.fit import Fit

LEAST_ERROR = 1e-3
"""Smaller errors count as this [mm]; an exact fit would have no texture."""
NEAREST, FURTHEST = 0.025, 0.45
"""Angles between two readings over which the variogram is fitted [rad]."""


def measure_misfit(fits: Sequence[Fit], trained: Sequence[Float64[np.ndarray, " k"]]) -> Misfit:
    """Size and texture of the misfit, from best fits to unseen outlines and from the differences
    of the support functions of training outlines [mm]; the texture is in the median over outlines.
    """
    if not fits or not trained:
        raise ValueError(
            f"got {len(fits)} unseen and {len(trained)} training outlines, expected some of both"
        )
    sizes = np.array([root_mean_square(fit.hull_errors_mm) for fit in fits])
    lags, variograms = zip(*(variogram(fit.hull_errors_mm) for fit in fits), strict=True)
    steep = [root_mean_square(f.hull_slopes_mm) / s for f, s in zip(fits, sizes, strict=True)]
    width, grain = fit_variogram(lags[0], np.median(variograms, axis=0))
    whole = 1 + grain**2
    rough = float(np.median(steep)) ** 2 * whole - 1 / (2 * width**2)
    logs = [np.log(sizes), np.log([root_mean_square(error) for error in trained])]
    mean = np.mean([group.mean() for group in logs])
    square = np.mean([np.square(group - mean).mean() for group in logs])
    sd = float(np.exp(mean)) / whole**0.5 / 1000.0
    return Misfit(sd, float(square) ** 0.5, width, grain, max(rough, 0.0) ** 0.5)


def variogram(
    error: Float64[np.ndarray, " k"],
) -> tuple[Float64[np.ndarray, " l"], Float64[np.ndarray, " l"]]:
    """Lags between `NEAREST` and `FURTHEST` [rad], and the variogram there of an error that is
    known at k angles all around, relative to its mean square."""
    step = 2 * np.pi / len(error)
    shifts = np.arange(round(NEAREST / step), round(FURTHEST / step) + 1)
    squares = [np.square(np.roll(error, -shift) - error).mean() for shift in shifts]
    return shifts * step, np.array(squares) / (2 * root_mean_square(error) ** 2)


def fit_variogram(
    lags: Float64[np.ndarray, " l"], values: Float64[np.ndarray, " l"]
) -> tuple[float, float]:
    """Width [rad] and grain whose variogram has the least squared distance from `values`."""

    def distance(guess: np.ndarray) -> np.ndarray:
        width, share = guess
        return 1 - share * np.exp(-(lags**2) / (4 * width**2)) - values

    found = least_squares(distance, (0.15, 0.9), bounds=((0.02, 0.1), (2.0, 1.0)))
    width, share = (float(value) for value in found.x)
    return width, (1 / share - 1) ** 0.5


def root_mean_square(error_mm: Float64[np.ndarray, " k"]) -> float:
    """Root mean square of an error [mm], at least `LEAST_ERROR`."""
    return max(float(np.sqrt(np.square(error_mm).mean())), LEAST_ERROR)
