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

DEGREES_OF_FREEDOM = 8.0
_RIDGE = 1e-6


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
        half = torch.full((count,), DEGREES_OF_FREEDOM / 2, dtype=self.mean.dtype)
        chi_square = 2 * torch._standard_gamma(half, generator=generator)
        scaled = normal * (DEGREES_OF_FREEDOM / chi_square).sqrt()[:, None]
        return self.mean[component] + (self.factor[component] @ scaled[..., None])[..., 0]

    def log_density(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log density of the mixture."""
        d, nu = self.mean.shape[-1], DEGREES_OF_FREEDOM
        offset = (points[:, None, :] - self.mean).transpose(0, 1)
        scaled = torch.linalg.solve_triangular(self.factor, offset.mT, upper=False)
        square = (scaled**2).sum(-2)
        constant = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
        scale = self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        each = constant - scale[:, None] - (nu + d) / 2 * torch.log1p(square / nu)
        return torch.logsumexp(each + self.log_share[:, None], dim=0)


def fit_student_mixture(
    points: Float[Tensor, "m d"],
    weights: Float[Tensor, " m"],
    components: int,
    generator: torch.Generator,
    rounds: int = 8,
) -> StudentMixture:
    """Fit by expectation maximisation of a normal mixture, started at random particles.

    `weights` sum to 1. Scale matrices are shrunk towards the covariance of all particles
    where a component has few, so that none collapses.
    """
    d = points.shape[-1]
    mean_all = weights @ points
    centred = points - mean_all
    covariance_all = (centred * weights[:, None]).T @ centred
    covariance_all = covariance_all + _RIDGE * torch.diag(
        covariance_all.diagonal().clamp_min(1e-12)
    )
    start = torch.multinomial(weights, components, replacement=True, generator=generator)
    mean = points[start]
    covariance = covariance_all.expand(components, d, d) / components ** (2 / d)
    share = torch.full((components,), 1 / components, dtype=points.dtype)
    effective = 1 / (weights**2).sum()
    for _ in range(rounds if components > 1 else 1):
        factor = torch.linalg.cholesky(covariance)
        offset = (points[:, None, :] - mean).transpose(0, 1)
        scaled = torch.linalg.solve_triangular(factor, offset.mT, upper=False)
        log_density = -0.5 * (scaled**2).sum(-2)
        log_density = log_density - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, None]
        responsibility = torch.softmax(log_density + share.log()[:, None], dim=0) * weights
        mass = responsibility.sum(-1)
        mean = (responsibility @ points) / mass.clamp_min(1e-12)[:, None]
        offset = (points[:, None, :] - mean).transpose(0, 1)
        scatter = (offset * responsibility[..., None]).mT @ offset
        # As if each component had seen d + 1 particles from the whole cloud.
        prior = (d + 1) / (effective * mass + d + 1)
        covariance = (1 - prior)[:, None, None] * scatter / mass.clamp_min(1e-12)[:, None, None]
        covariance = covariance + prior[:, None, None] * covariance_all
        share = mass.clamp_min(1e-6) / mass.clamp_min(1e-6).sum()
    return StudentMixture(share.log(), mean, torch.linalg.cholesky(covariance))
