"""A mixture of Student distributions in flat coordinates, spread over weighted points.

Where the posterior is nearly normal, components need not follow its curvature: those of one
covariance, that of all points, at points drawn by weight, meet it better than many small ones.
How wide they are is not known, so there are several widths. Centres are drawn towards the mean,
so that the mixture has the covariance of its points whatever the width (West 1993).

Axes: m points, d scores, k centres, w widths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.proposals import DEGREES_OF_FREEDOM, summed
from tpcd.belief.resampling import systematic_resample

WIDTHS = (0.3, 0.6, 1.0, 1.5)
"""Of components, relative to the deviations of the points."""
_LEAST_VARIANCE = 1e-8
_LEAST_SHARE = 1e-6
"""Of its variance that each entry has by itself: few points may lie on a line."""
_POINTS_AT_ONCE = 100


@dataclass(frozen=True, eq=False)
class FlatMixture:
    """Components of each width at each centre."""

    mean: Float[Tensor, " d"]
    """Of the points, in flat coordinates."""
    factor: Float[Tensor, "d d"]
    """Cholesky factor of their covariance."""
    centres: Float[Tensor, "k b"]
    """Of the b entries that components are narrow in, in standard units: `factor` times these, from
    the mean."""
    order: Int[Tensor, " d"]
    """Those b entries first, in the order of mean and factor."""
    shares: Float[Tensor, " w"]
    """Share of each width in the mixture."""

    def draw(self, count: int, generator: torch.Generator) -> Float[Tensor, "count d"]:
        """So many draws, shared out evenly over the widths."""
        chosen = systematic_resample(self.shares, count, generator)
        width = self.mean.new_tensor(WIDTHS)[chosen, None]
        index = torch.randint(len(self.centres), (count,), generator=generator)
        shape, dtype = (count, len(self.mean)), self.mean.dtype
        normal = torch.randn(shape, generator=generator, dtype=dtype)
        squares = torch.randn((count, DEGREES_OF_FREEDOM), generator=generator, dtype=dtype)
        stretch = (DEGREES_OF_FREEDOM / squares.square().sum(-1, keepdim=True)).sqrt()
        unit = normal * stretch
        b = self.centres.shape[-1]
        unit[:, :b] = _kept(width) * self.centres[index] + width * unit[:, :b]
        flat = torch.empty_like(unit)
        flat[:, self.order] = self.mean + unit @ self.factor.mT
        return flat

    def log_densities(self, flat: Float[Tensor, "m d"]) -> Float[Tensor, "m w"]:
        """Log of share times density of the components of each width."""
        d, nu = len(self.mean), DEGREES_OF_FREEDOM
        peak = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
        peak = peak - float(self.factor.diagonal().log().sum()) - math.log(len(self.centres))
        away = (flat[:, self.order] - self.mean).mT
        unit = torch.linalg.solve_triangular(self.factor, away, upper=False).mT
        total = self._sums(unit)
        width = self.mean.new_tensor(WIDTHS)
        b = self.centres.shape[-1]
        return total.log() - b * width.log() + peak + self.shares.log()

    def _sums(self, unit: Tensor) -> Tensor:
        """Sums (m, w) over the centres of densities without their peaks."""
        from tpcd.belief.mixture_kernel import FlatComponents, flat_sum_range

        width = unit.new_tensor(WIDTHS)
        parts = (self.centres.mT, width, _kept(width))
        components = FlatComponents(*(part.contiguous().numpy() for part in parts))
        return summed(flat_sum_range, unit, components, len(WIDTHS))


def flat_mixture(
    flat: Float[Tensor, "m d"],
    weights: Float[Tensor, " m"],
    centres: Float[Tensor, "k d"],
    shares: Float[Tensor, " w"],
    broad: Sequence[int] = (),
) -> FlatMixture:
    """With the covariance of weighted points, at some centres, in flat coordinates; as `broad` as
    the points themselves in some entries, given the others."""
    narrow = [entry for entry in range(flat.shape[-1]) if entry not in broad]
    order = torch.tensor([*narrow, *broad])
    flat, centres = flat[:, order], centres[:, order]
    mean = weights @ flat
    away = flat - mean
    covariance = away.mT @ (away * weights[:, None])
    least = _LEAST_VARIANCE + _LEAST_SHARE * covariance.diagonal()
    factor = torch.linalg.cholesky(covariance + torch.diag(least))
    unit = torch.linalg.solve_triangular(factor, (centres - mean).mT, upper=False).mT
    return FlatMixture(mean, factor, unit[:, : len(narrow)], order, shares / shares.sum())


def _kept(width: Tensor) -> Tensor:
    """Share of its distance from the mean that a centre keeps."""
    return (1.0 - width**2).clamp_min(0.0).sqrt()
