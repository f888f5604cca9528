"""The posterior that the sampler moves in: scores of theta and, last, of the misfit's size."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.likelihood import (
    HistoryLikelihood,
    history_likelihood,
)
from tpcd.belief.linearised import linearised_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.simulator import StepSettings, native

_LARGE_MISFIT = 2.0
"""Added to the score of the misfit's size."""
_DIFFERENCE = 0.01
"""Step of differences, in standard deviations of the prior."""


@dataclass(frozen=True, eq=False)
class ContactTarget:
    """Log posterior over d + 1 unconstrained coordinates, given a history of contact."""

    prior: ParameterPrior
    misfit: MisfitField
    step: StepSettings
    history: History | None = None

    def given(self, history: History) -> ContactTarget:
        """The same with a history."""
        return replace(self, history=history)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "m s"]:
        """Draws from the prior."""
        score = self.prior.sample(count, generator)
        misfit = torch.randn(count, 1, generator=generator, dtype=torch.float64)
        return torch.cat((score, misfit), dim=-1)

    def scatter(self, count: int, generator: torch.Generator) -> Float[Tensor, "m s"]:
        """Draws from the prior, every other one with a large misfit: the larger it is, the
        smoother the posterior is to climb, as at a higher temperature."""
        score = self.sample(count, generator)
        score[::2, -1] += _LARGE_MISFIT
        return score

    def log_prior(self, score: Float[Tensor, "m s"]) -> Float[Tensor, " m"]:
        """Log density of the prior."""
        normal = -0.5 * score[:, -1] ** 2 - 0.5 * math.log(2 * math.pi)
        return self.prior.log_density(score[:, :-1]) + normal

    def log_likelihood(
        self, score: Float[Tensor, "m s"], least: Float[Tensor, " m"] | None
    ) -> Float[Tensor, " m"]:
        """Log likelihood of the history; -inf where it may stay below `least`."""
        return self.evaluate(score, least).total

    def curvature(
        self, score: Float[Tensor, "m s"]
    ) -> tuple[Float[Tensor, "m s"], Float[Tensor, "m s s"]]:
        """Gradient of the log posterior and its Fisher information, from the derivatives of
        the innovations.

        Entries that cannot be evaluated count as flat.
        """
        found = self._linearised(score)
        here = torch.nan_to_num(found.whitened).flatten(1)
        slopes = torch.nan_to_num(found.slopes, 0.0, 0.0, 0.0).flatten(2)
        stretch = torch.nan_to_num(found.stretch, 0.0, 0.0, 0.0).flatten(2)
        gradient = -(slopes @ here[..., None])[..., 0] - stretch.sum(-1)
        information = slopes @ slopes.mT + 2 * stretch @ stretch.mT
        rise, precision = self.prior.curvature(score[:, :-1])
        information[:, :-1, :-1] += precision
        information[:, -1, -1] += 1.0
        return gradient + torch.cat((rise, -score[:, -1:]), dim=-1), information

    def _linearised(self, score: Tensor) -> _Linearised:
        """Innovations and their derivatives: compiled for theta and by a difference for the
        size of the misfit; by differences throughout where compiled loops are not to be had."""
        s = score.shape[-1]
        if not native.available() or score.device.type != "cpu":
            steps = torch.diag(score.new_full((s,), _DIFFERENCE))
            moved = score + torch.cat((score.new_zeros(1, s), steps))[:, None]
            found = self.evaluate(moved.flatten(0, 1), innovations=True)
            parts = (found.whitened, found.log_scale)
            whitened, log_scale = (_known(p).unflatten(0, (s + 1, -1)) for p in parts)
            slopes, stretch = (
                ((v[1:] - v[0]) / _DIFFERENCE).movedim(0, 1) for v in (whitened, log_scale)
            )
            return _Linearised(whitened[0], slopes, stretch)
        assert self.history is not None
        vectors, slope = self.prior.to_vector_with_slope(score[:, :-1])
        here = linearised_likelihood(
            self.prior.shape,
            vectors,
            slope,
            self.misfit.sd_of(score[:, -1]),
            self.history,
            self.misfit,
            self.step,
        )
        moved = score + torch.cat((score.new_zeros(s - 1), score.new_full((1,), _DIFFERENCE)))
        there = self.evaluate(moved, innovations=True)
        last, stretch = (
            (_known(b) - _known(a)) / _DIFFERENCE
            for a, b in ((here.whitened, there.whitened), (here.log_scale, there.log_scale))
        )
        slopes = torch.cat((_known(here.slopes), last[:, None]), dim=1)
        still = torch.zeros_like(slopes[:, :-1])
        return _Linearised(_known(here.whitened), slopes, torch.cat((still, stretch[:, None]), 1))

    def evaluate(
        self,
        score: Float[Tensor, "m s"],
        least: Float[Tensor, " m"] | None = None,
        innovations: bool = False,
    ) -> HistoryLikelihood:
        """What the particles say about the history."""
        assert self.history is not None
        return history_likelihood(
            self.prior.shape,
            self.prior.to_parameters(score[:, :-1]),
            self.misfit.sd_of(score[:, -1]),
            self.history,
            self.misfit,
            self.step,
            least,
            innovations,
        )


@dataclass(frozen=True)
class _Linearised:
    """Innovations (m, n, 3), and derivatives (m, s, n, 3) of them and of their log units."""

    whitened: Tensor
    slopes: Tensor
    stretch: Tensor


def _known(value: Tensor | None) -> Tensor:
    assert value is not None
    return value
