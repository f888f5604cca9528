"""Proposal distributions for moving particles: a normal mixture fitted to them, and local steps.

The mixture has heavier tails than the particles (a multivariate Student t for each
component), as an independence sampler needs. Axes: m particles, k components, d dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

DEGREES_OF_FREEDOM = 16
_RIDGE = 1e-6
_LEAST_SHARE = 10.0
"""A component counts as empty below the even share divided by this."""


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of multivariate Student t distributions."""

    log_share: Float[Tensor, " k"]
    mean: Float[Tensor, "k d"]
    factor: Float[Tensor, "k d d"]
    """Cholesky factors of the scale matrices."""

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count d"]:
        """Draw from the mixture."""
        d = self.mean.shape[-1]
        component = torch.multinomial(
            self.log_share.exp(), count, replacement=True, generator=generator
        )
        normal = torch.randn(count, d, generator=generator, dtype=self.mean.dtype)
        squares = torch.randn(count, DEGREES_OF_FREEDOM, generator=generator, dtype=normal.dtype)
        chi_square = (squares**2).sum(-1)
        scaled = normal * (DEGREES_OF_FREEDOM / chi_square).sqrt()[:, None]
        return self.mean[component] + (self.factor[component] @ scaled[..., None])[..., 0]

    def log_density(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log density of the mixture."""
        d, nu = self.mean.shape[-1], DEGREES_OF_FREEDOM
        square, scale = _squares(points, self.mean, self.factor)
        constant = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
        each = constant - scale[:, None] - (nu + d) / 2 * torch.log1p(square / nu)
        return torch.logsumexp(each + self.log_share[:, None], dim=0)


def fit_student_mixture(
    points: Float[Tensor, "m d"],
    weights: Float[Tensor, " m"],
    components: int,
    generator: torch.Generator,
    rounds: int = 30,
    start: StudentMixture | None = None,
) -> StudentMixture:
    """Fit by expectation maximisation of a normal mixture, from `start` or random particles.

    `start` must have as many components.

    `weights` sum to 1. Scale matrices are shrunk towards the covariance of all particles
    where a component has few, so that none collapses.
    """
    d = points.shape[-1]
    mean_all = weights @ points
    centred = points - mean_all
    covariance_all = (centred * weights[:, None]).T @ centred
    ridge = _RIDGE * torch.diag(covariance_all.diagonal().clamp_min(1e-12))
    covariance_all = covariance_all + ridge
    # Second moments of all components are one product with the squares of the points.
    squares = (centred[:, :, None] * centred[:, None, :]).flatten(1)
    chosen = torch.multinomial(weights, components, replacement=True, generator=generator)
    mean = points[chosen]
    factor = torch.linalg.cholesky(covariance_all).expand(components, d, d) / components ** (1 / d)
    log_share = torch.full((components,), -math.log(components), dtype=points.dtype)
    if start is not None:
        # A component that has lost its particles starts afresh.
        alive = start.log_share > log_share - math.log(_LEAST_SHARE)
        mean = torch.where(alive[:, None], start.mean, mean)
        factor = torch.where(alive[:, None, None], start.factor, factor)
        log_share = torch.log_softmax(torch.where(alive, start.log_share, log_share), dim=0)
    effective = 1 / (weights**2).sum()
    for _ in range(rounds if components > 1 else 1):
        square, scale = _squares(points, mean, factor)
        log_density = log_share[:, None] - scale[:, None] - 0.5 * square
        responsibility = torch.softmax(log_density, dim=0) * weights
        mass = responsibility.sum(-1)
        share = responsibility / mass.clamp_min(1e-12)[:, None]
        shift = share @ centred
        mean = mean_all + shift
        scatter = (share @ squares).unflatten(1, (d, d)) - shift[:, :, None] * shift[:, None, :]
        # As if each component had seen d + 1 particles from the whole cloud.
        prior = (d + 1) / (effective * mass + d + 1)
        covariance = (1 - prior)[:, None, None] * scatter + ridge
        covariance = covariance + prior[:, None, None] * covariance_all
        factor = torch.linalg.cholesky(covariance)
        log_share = (mass.clamp_min(1e-6) / mass.clamp_min(1e-6).sum()).log()
    return StudentMixture(log_share, mean, factor)


def _squares(points: Tensor, mean: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
    """Squared Mahalanobis distances (k, m) from each component, and log scales (k)."""
    # Inverting a few small factors is cheaper than solving with each of them for all points.
    identity = torch.eye(points.shape[-1], dtype=points.dtype)
    inverse = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
    scaled = inverse @ points.T - inverse @ mean[..., None]
    return (scaled**2).sum(-2), factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
