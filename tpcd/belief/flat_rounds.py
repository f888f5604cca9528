"""Adaptive importance sampling in flat coordinates.

Each round draws from a mixture around the draws that the weights so far choose, and all draws are
weighted under the start (`flat_start`) and the mixtures of all rounds (AMIS: Cornuet et al. 2012).
Mean and covariance of a mixture are those of many draws, however few have the weight (nonlinear
importance sampling: Koblents and Miguez 2015).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Coordinates, Target
from tpcd.belief.flat_mixture import WIDTHS, FlatMixture, flat_mixture
from tpcd.belief.flat_start import FlatDraws, FlatStart, log_start
from tpcd.belief.resampling import effective_sample_size
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.weights import (
    evened,
    finite,
    known_weights,
    spread_choice,
    threshold,
    truncate,
)

CENTRES = 200
"""Points that each round puts components at."""
_LEAST_SHARE = 0.05
"""Share of the draws that each width keeps at least."""


@dataclass(frozen=True, eq=False)
class FlatProposal:
    """The mixtures of all rounds, drawn from equally often, and where the next one begins."""

    coordinates: Coordinates
    mixtures: tuple[FlatMixture, ...]
    flat: Float[Tensor, "m d"]
    """Draws in flat coordinates,"""
    log_weights: Float[Tensor, " m"]
    """and their weights."""
    shares: Float[Tensor, " w"]
    """What draws of each width were worth."""
    starts: FlatDraws
    """Draws from all over the prior, which count beside those of the rounds."""

    def begun(
        self, positions: Float[Tensor, "n d"], log_weights: Float[Tensor, " n"]
    ) -> FlatProposal:
        """The same, with other draws (scores) where the next mixture begins."""
        flat, log_weights = _flat_of(self.coordinates, positions, log_weights)
        return replace(self, flat=flat, log_weights=log_weights)

    def draw(self, count: int, generator: torch.Generator) -> Float[Tensor, "count d"]:
        """So many draws, as scores; those that leave a box are infinite there."""
        n = len(self.mixtures)
        each = [count // n + (k < count % n) for k in range(n)]
        pairs = zip(self.mixtures, each, strict=True)
        flat = torch.cat([mixture.draw(often, generator) for mixture, often in pairs])
        return self.coordinates.to_score(flat)[0]

    def log_density(self, positions: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """Log density in scores."""
        flat, log_slope = self.coordinates.from_score(positions)
        each = torch.cat([mixture.log_densities(flat) for mixture in self.mixtures], -1)
        return torch.logsumexp(each, -1) - math.log(len(self.mixtures)) - log_slope


def begin(
    start: FlatStart, positions: Float[Tensor, "m d"], log_weights: Float[Tensor, " m"]
) -> FlatProposal:
    """A proposal still without mixtures, whose first one begins at weighted draws (scores)."""
    flat, log_weights = _flat_of(start.coordinates, positions, log_weights)
    shares = flat.new_ones(len(WIDTHS))
    return FlatProposal(start.coordinates, (), flat, log_weights, shares, start.draws)


def adapt_flat(
    target: Target,
    proposal: FlatProposal,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> FlatProposal:
    """The proposal with the mixtures of so many rounds more."""
    flat, log_weights, shares = proposal.flat, proposal.log_weights, proposal.shares
    entries = proposal.coordinates.entries
    mixtures: tuple[FlatMixture, ...] = ()
    draws = proposal.starts
    enough = False
    for k in range(settings.flat_rounds):
        centres = flat[spread_choice(log_weights, CENTRES, generator)]
        weights = evened(log_weights, math.sqrt(len(log_weights)))
        mixtures = (*mixtures, flat_mixture(flat, weights, centres, shares, entries))
        if enough or k + 1 == settings.flat_rounds:
            break
        draws, of_last = _with_a_round(target, proposal, mixtures, draws, settings, generator)
        if not bool((draws.log_weights > -torch.inf).any()):
            continue  # The next one begins where this one did.
        flat, log_weights = draws.flat, draws.log_weights
        weights = known_weights(log_weights)
        enough = effective_sample_size(weights) > settings.flat_worth
        worth = truncate(weights) @ of_last.softmax(-1).nan_to_num(0.0)
        shares = worth.clamp_min(_LEAST_SHARE)
    return replace(
        proposal,
        mixtures=(*proposal.mixtures, *mixtures),
        flat=flat,
        log_weights=log_weights,
        shares=shares,
    )


def _flat_of(
    coordinates: Coordinates, positions: Tensor, log_weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Draws that have a weight."""
    some = log_weights > -torch.inf
    return coordinates.from_score(positions[some])[0], log_weights[some]


def _with_a_round(
    target: Target,
    proposal: FlatProposal,
    mixtures: tuple[FlatMixture, ...],
    before: FlatDraws,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> tuple[FlatDraws, Tensor]:
    """All draws with those from the last of the mixtures, and its log densities at them."""
    new = mixtures[-1].draw(settings.flat_draws, generator)
    score, log_slope = proposal.coordinates.to_score(new)
    log_prior = target.log_prior(score)
    flat = torch.cat((before.flat, new))
    of_last = mixtures[-1].log_densities(flat)
    often, count = math.log(len(new)), len(new)
    log_sum = torch.logsumexp(of_last, -1) + often
    here = [mixture.log_densities(new) + often for mixture in mixtures[:-1]]
    start = log_start(proposal.coordinates, new, score, log_prior) + math.log(before.starts)
    here = torch.cat((*here, finite(start)[:, None], log_sum[-count:, None]), -1)
    here = torch.logsumexp(here, -1)
    log_sum = torch.cat((torch.logaddexp(before.log_sum, log_sum[:-count]), here))
    log_prior = finite(log_prior + log_slope)
    best, least = before.trusted, None
    if math.isfinite(best):
        least = threshold(best, here, log_prior)
    log_target = finite(log_prior + target.log_likelihood(score, least))
    log_target = torch.cat((before.log_target, log_target))
    return FlatDraws(flat, log_target, log_sum, before.starts), of_last
