"""Proposals for importance sampling: a mixture that follows the target's own curvature.

A posterior of contact is a thin, bent sheet: some combinations of shape, mount and terrain
are known a hundred times better than others, and which ones changes from place to place. No
covariance of the whole cloud fits that. Components therefore sit at many places x, with the
covariance that the linearised model gives there.

Along the directions that are hardly known, the linearised model holds only nearby: the sheet
bends. With gradient g and information L of the log target at x, a component has the centre
x + a (L + t I)^-1 g and the covariance (L + t I)^-1: the step of Levenberg (1944) and
Marquardt (1963), whose damping t shortens the flat directions and leaves the steep ones as
they are. How much damping a place needs is not known, so each gets one component for each
of several. How many draws go to each damping follows from what such draws were worth
(population Monte Carlo over kernels: Douc, Guillin, Marin and Robert 2007).

Axes: m points, k places, t dampings, d dimensions; coordinates are scores, of prior standard
deviation 1. Components have Student tails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.resampling import systematic_resample
from tpcd.threads import in_parts

DEGREES_OF_FREEDOM = 5
DAMPINGS = (0.0, 1.0, 4.0, 16.0, 64.0)
"""Information added in all directions: with 4, a component reaches no further than 0.5."""
STEP_SHARE = 0.8
"""Share a of the damped Newton step that a component's centre goes."""
_LEAST_INFORMATION = 1e-6
_POINTS_AT_ONCE = 256
"""Points whose distances to all components are held in memory at once, without compiled loops."""


@dataclass(frozen=True, eq=False)
class CurvedMixture:
    """A mixture of multivariate Student t distributions, t of them at each of k places."""

    axes: Float[Tensor, "k d d"]
    """Principal axes of the information at each place, one in each row."""
    place: Float[Tensor, "k d"]
    """The places, in coordinates along their axes."""
    offset: Float[Tensor, "k t d"]
    """From the place to the centre of each component, along the axes."""
    spread: Float[Tensor, "k t d"]
    """Scale of each component along the axes."""
    counts: Float[Tensor, "k t"]
    """Whole numbers that share the mixture out: how often each component is drawn from."""

    def draw(self, generator: torch.Generator) -> Float[Tensor, "m d"]:
        """Draw from each component as often as it counts."""
        return self._draw(self.counts.flatten().long(), generator)

    def draw_some(self, count: int, generator: torch.Generator) -> Float[Tensor, "m d"]:
        """So many draws from the mixture, spread evenly over its components."""
        chosen = systematic_resample(self.counts.flatten(), count, generator)
        return self._draw(chosen.bincount(minlength=self.counts.numel()), generator)

    def _draw(self, often: Tensor, generator: torch.Generator) -> Tensor:
        component = torch.arange(len(often)).repeat_interleave(often)
        t = self.counts.shape[1]
        place, damping = component // t, component % t
        size = (len(place), self.axes.shape[-1])
        normal = torch.randn(size, generator=generator, dtype=self.axes.dtype)
        squares = torch.randn(
            len(place), DEGREES_OF_FREEDOM, generator=generator, dtype=normal.dtype
        ).square()
        stretch = (DEGREES_OF_FREEDOM / squares.sum(-1, keepdim=True)).sqrt()
        centre = self.place[place] + self.offset[place, damping]
        along = centre + self.spread[place, damping] * normal * stretch
        return (self.axes[place].mT @ along[..., None])[..., 0]

    @classmethod
    def joined(cls, parts: Sequence[CurvedMixture]) -> CurvedMixture:
        """All components of some mixtures."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(torch.cat(column) for column in columns))

    def log_density(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log density of the mixture."""
        return self.log_sum(points) - self.counts.sum().log()

    def log_sum(self, points: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log of the sum over components of count times density."""
        return torch.logsumexp(self.log_sums(points), dim=-1)

    def log_sums(self, points: Float[Tensor, "m d"]) -> Float[Tensor, "m t"]:
        """The same for the components of each damping by themselves."""
        d, nu = self.offset.shape[-1], DEGREES_OF_FREEDOM
        constant = math.lgamma((nu + d) / 2) - math.lgamma(nu / 2) - d / 2 * math.log(nu * math.pi)
        log_peak = self.counts.log() - self.spread.log().sum(-1)
        highest = log_peak.max()
        peak = (log_peak - highest).exp()
        return self._sum(points, peak).log() + highest + constant

    def _sum(self, points: Tensor, peak: Tensor) -> Tensor:
        from tpcd.belief.mixture_kernel import Components, sum_range

        # The places last: the loops over them are the long ones.
        parts = (
            self.axes.permute(1, 2, 0),
            self.place.T,
            self.offset.permute(1, 2, 0),
            self.spread.reciprocal().permute(1, 2, 0),
            peak.T,
        )
        components = Components(*(part.contiguous().numpy() for part in parts))
        return summed(sum_range, points, components, self.offset.shape[1])


def summed(
    sum_range: Callable[..., None],
    points: Float[Tensor, "m d"],
    components: tuple,
    sizes: int,
) -> Float[Tensor, "m t"]:
    """Sums of densities at points over components of each of t sizes, by a compiled loop."""
    total = torch.empty(len(points), sizes, dtype=torch.float64)
    given, found = points.contiguous().numpy(), total.numpy()
    in_parts(
        lambda first, last: sum_range(given, components, DEGREES_OF_FREEDOM, found, first, last),
        len(points),
    )
    return total


def curved_mixture(
    points: Float[Tensor, "k d"],
    gradient: Float[Tensor, "k d"],
    information: Float[Tensor, "k d d"],
    counts: Float[Tensor, " t"],
    share: float = STEP_SHARE,
    dampings: Sequence[float] = DAMPINGS,
) -> CurvedMixture:
    """Components at k places, from the gradient of the log target there and its information.

    `counts` says how often to draw with each damping at every place.
    """
    values, vectors = torch.linalg.eigh(information)
    axes = vectors.mT
    damping = torch.tensor(dampings, dtype=values.dtype)[:, None]
    damped = values.clamp_min(_LEAST_INFORMATION)[:, None] + damping
    place, slope = ((axes @ v[..., None])[..., 0] for v in (points, gradient))
    offset = share * slope[:, None] / damped
    return CurvedMixture(axes, place, offset, damped.rsqrt(), counts.expand(len(points), -1))
