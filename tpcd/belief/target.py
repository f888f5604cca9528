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
    Threshold,
    history_likelihood,
    linearised_likelihood,
)
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.simulator import StepSettings, native

_PRIOR_DRAWS = 2000
_DIFFERENCE = 0.05
"""Step of the differences, in standard deviations of the particles: well over the kinks of a
contact, well under what is left to learn."""
_LARGEST_DIFFERENCE = 0.05


@dataclass(frozen=True, eq=False)
class ContactTarget:
    """Log posterior over d + 1 unconstrained coordinates, given a history of contact."""

    prior: ParameterPrior
    misfit: MisfitField
    step: StepSettings
    prior_mean: Float[Tensor, " s"]
    prior_precision: Float[Tensor, "s s"]
    """Normal fit of the prior, for proposals only."""
    history: History | None = None

    def given(self, history: History) -> ContactTarget:
        """The same with a history."""
        return replace(self, history=history)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "m s"]:
        """Draws from the prior."""
        return _draw(self.prior, count, generator)

    def log_prior(self, score: Float[Tensor, "m s"]) -> Float[Tensor, " m"]:
        """Log density of the prior."""
        normal = -0.5 * score[:, -1] ** 2 - 0.5 * math.log(2 * math.pi)
        return self.prior.log_density(score[:, :-1]) + normal

    def log_likelihood(
        self, score: Float[Tensor, "m s"], threshold: Threshold | None
    ) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
        """Log likelihood of all transitions but the last, and of all."""
        found = self.evaluate(score, threshold)
        return found.before, found.total

    def curvature(
        self, score: Float[Tensor, "m s"], spread: Float[Tensor, " s"], temperature: float
    ) -> tuple[Float[Tensor, "m s"], Float[Tensor, "m s s"]]:
        """Gradient of the log posterior with the last transition tempered, and its Fisher
        information, from the derivatives of the innovations; `spread` is that of the particles.

        Of the prior its normal fit is taken. Entries that cannot be evaluated count as flat.
        """
        found = self._linearised(score, spread)
        share = score.new_ones(found.whitened.shape[1], 1)
        share[-1] = temperature
        root = share.sqrt()
        here = torch.nan_to_num(root * found.whitened).flatten(1)
        slopes = torch.nan_to_num(root * found.slopes, 0.0, 0.0, 0.0).flatten(2)
        stretch = torch.nan_to_num(root * found.stretch, 0.0, 0.0, 0.0).flatten(2)
        prior = (self.prior_mean - score) @ self.prior_precision
        gradient = prior - (slopes @ here[..., None])[..., 0]
        gradient = gradient - stretch @ root.expand(-1, 3).flatten()
        information = self.prior_precision + slopes @ slopes.mT + 2 * stretch @ stretch.mT
        return gradient, information

    def _linearised(self, score: Tensor, spread: Tensor) -> _Linearised:
        """Innovations and their derivatives: compiled for theta and by a difference for the
        size of the misfit; by differences throughout where compiled loops are not to be had."""
        s = score.shape[-1]
        steps = (_DIFFERENCE * spread).clamp(1e-6, _LARGEST_DIFFERENCE)
        if not native.available() or score.device.type != "cpu":
            moved = score + torch.cat((score.new_zeros(1, s), torch.diag(steps)))[:, None]
            found = self.evaluate(moved.flatten(0, 1), innovations=True)
            parts = (found.whitened, found.log_scale)
            whitened, log_scale = (_known(p).unflatten(0, (s + 1, -1)) for p in parts)
            slopes, stretch = (
                ((v[1:] - v[0]) / steps[:, None, None, None]).movedim(0, 1)
                for v in (whitened, log_scale)
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
        moved = score + torch.cat((score.new_zeros(s - 1), steps[-1:]))
        there = self.evaluate(moved, innovations=True)
        last, stretch = (
            (_known(b) - _known(a)) / steps[-1]
            for a, b in ((here.whitened, there.whitened), (here.log_scale, there.log_scale))
        )
        slopes = torch.cat((_known(here.slopes), last[:, None]), dim=1)
        still = torch.zeros_like(slopes[:, :-1])
        return _Linearised(_known(here.whitened), slopes, torch.cat((still, stretch[:, None]), 1))

    def evaluate(
        self,
        score: Float[Tensor, "m s"],
        threshold: Threshold | None = None,
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
            threshold,
            innovations,
        )


@dataclass(frozen=True)
class _Linearised:
    """Innovations (m, n, 3), and derivatives (m, s, n, 3) of them and of their log units."""

    whitened: Tensor
    slopes: Tensor
    stretch: Tensor


def contact_target(prior: ParameterPrior, misfit: MisfitField, step: StepSettings) -> ContactTarget:
    """The target before any datum."""
    draws = _draw(prior, _PRIOR_DRAWS, torch.Generator().manual_seed(0))
    precision = torch.linalg.inv(torch.cov(draws.T))
    return ContactTarget(prior, misfit, step, draws.mean(0), precision)


def _known(value: Tensor | None) -> Tensor:
    assert value is not None
    return value


def _draw(prior: ParameterPrior, count: int, generator: torch.Generator) -> Tensor:
    score = prior.sample(count, generator)
    misfit = torch.randn(count, 1, generator=generator, dtype=torch.float64)
    return torch.cat((score, misfit), dim=-1)
