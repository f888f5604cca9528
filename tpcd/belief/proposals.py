"""Proposals for moving particles: a mixture of normals that follow the target's own curvature.

A posterior of contact is a thin, bent sheet: some combinations of shape, mount and terrain
are known a hundred times better than others, and which ones changes from place to place. No
covariance of the whole cloud fits that. Each component of the mixture therefore sits at a
particle and has the covariance that the linearised model gives there, the inverse Fisher
information (stochastic Newton: Martin et al. 2012; Girolami and Calderhead 2011).

The centre goes a share a of the Newton step n, x + a n, and the covariance C is scaled by
1 - (1 - a)^2. Where the target is normal, this keeps a cloud that already follows it.

Axes: m points, k components, d dimensions. Components have equal shares and Student tails.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

DEGREES_OF_FREEDOM = 5
NEWTON_SHARE = 0.4
"""Share of the Newton step that a component's centre goes."""


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of multivariate Student t distributions with equal shares."""

    mean: Float[Tensor, "k d"]
    factor: Float[Tensor, "k d d"]
    """Cholesky factors of the scale matrices."""

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count d"]:
        """Draw from the mixture."""
        component = torch.randint(len(self.mean), (count,), generator=generator)
        return self.draw(component, generator)

    def draw(
        self, component: Int[Tensor, " m"], generator: torch.Generator
    ) -> Float[Tensor, "m d"]:
        """Draw one point from each of the named components."""
        size = (len(component), self.mean.shape[-1])
        normal = torch.randn(size, generator=generator, dtype=self.mean.dtype)
        squares = torch.randn(
            len(component), DEGREES_OF_FREEDOM, generator=generator, dtype=normal.dtype
        )
        chi_square = (squares**2).sum(-1)
        scaled = normal * (DEGREES_OF_FREEDOM / chi_square).sqrt()[:, None]
        return self.mean[component] + self.stretch(component, scaled)

    def stretch(
        self, component: Int[Tensor, " m"], noise: Float[Tensor, "m d"]
    ) -> Float[Tensor, "m d"]:
        """Standard noise in the shape of a component for each point."""
        return (self.factor[component] @ noise[..., None])[..., 0]

    @classmethod
    def joined(cls, parts: Sequence[StudentMixture]) -> StudentMixture:
        """All components of some mixtures."""
        return cls(torch.cat([p.mean for p in parts]), torch.cat([p.factor for p in parts]))

    def log_density(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log density of the mixture."""
        return self.log_sum(points) - math.log(len(self.mean))

    def log_sum(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log of the sum of the component densities."""
        return torch.logsumexp(self.log_densities(points), dim=-1)

    def log_densities(self, points: Float[Tensor, "m d"]) -> Float[Tensor, "m k"]:
        """Log density of each component."""
        (k, d), nu = self.mean.shape, DEGREES_OF_FREEDOM
        # Inverting a few small factors is cheaper than solving with each of them for all points.
        identity = torch.eye(d, dtype=points.dtype).expand_as(self.factor)
        inverse = torch.linalg.solve_triangular(self.factor, identity, upper=False)
        offset = (inverse @ self.mean[..., None])[..., 0]
        scaled = (points @ inverse.flatten(0, 1).T).unflatten(1, (k, d)) - offset
        scale = self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
        square = (scaled**2).sum(-1)
        return constant - scale - (nu + d) / 2 * torch.log1p(square / nu)


def newton_mixture(
    points: Float[Tensor, "k d"],
    gradient: Float[Tensor, "k d"],
    information: Float[Tensor, "k d d"],
    share: float = NEWTON_SHARE,
) -> StudentMixture:
    """Components at k particles, from the gradient of the log target there and its information."""
    lower = torch.linalg.cholesky(information)
    step = torch.cholesky_solve(gradient[..., None], lower)[..., 0]
    identity = torch.eye(points.shape[-1], dtype=points.dtype).expand_as(lower)
    covariance = torch.cholesky_solve(identity, lower)
    factor = torch.linalg.cholesky(0.5 * (covariance + covariance.mT))
    return StudentMixture(points + share * step, math.sqrt(1 - (1 - share) ** 2) * factor)
