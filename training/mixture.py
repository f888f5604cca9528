"""Gaussian mixtures fitted by expectation maximisation, in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.special import logsumexp

ROUNDS = 60
"""Rounds of expectation maximisation; the likelihood has settled well before."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """Weights, means and lower Cholesky factors of the covariances."""

    weights: Float64[np.ndarray, " k"]
    means: Float64[np.ndarray, "k z"]
    factors: Float64[np.ndarray, "k z z"]

    def log_parts(self, points: Float64[np.ndarray, "m z"]) -> Float64[np.ndarray, "m k"]:
        """Log of weight times density of each component."""
        offset = points[None] - self.means[:, None]
        white = np.linalg.solve(self.factors, np.swapaxes(offset, 1, 2))
        log_scale = np.log(np.diagonal(self.factors, axis1=1, axis2=2)).sum(-1)
        constant = 0.5 * points.shape[1] * np.log(2 * np.pi)
        square = np.square(white).sum(axis=1).T
        return np.log(self.weights) - log_scale - constant - 0.5 * square

    def draw(self, count: int, rng: np.random.Generator) -> Float64[np.ndarray, "m z"]:
        """Independent draws."""
        pick = rng.choice(len(self.weights), size=count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1], 1))
        return self.means[pick] + (self.factors[pick] @ noise)[..., 0]


def fit_mixture(
    points: Float64[np.ndarray, "m z"], components: int, rng: np.random.Generator
) -> Mixture:
    """Fit by expectation maximisation (Dempster, Laird and Rubin 1977), full covariances.

    A hundredth of the points' covariance is added to each component's, so that none can
    collapse onto a few points.
    """
    m, z = points.shape
    ridge = 0.01 * np.cov(points.T) + 1e-9 * np.eye(z)
    centres = points[rng.choice(m, components, replace=False)]
    nearest = np.square(points[:, None] - centres[None]).sum(-1).argmin(axis=1)
    shares = np.eye(components)[nearest]
    for _ in range(ROUNDS):
        total = shares.sum(axis=0) + 1e-9
        means = shares.T @ points / total[:, None]
        offset = points[None] - means[:, None]
        covariance = np.einsum("mk,kmi,kmj->kij", shares, offset, offset, optimize=True)
        covariance = covariance / total[:, None, None] + ridge
        mixture = Mixture(total / total.sum(), means, np.linalg.cholesky(covariance))
        parts = mixture.log_parts(points)
        shares = np.exp(parts - logsumexp(parts, axis=1, keepdims=True))
    return mixture
