"""Draws from all over the prior that agree with the readings in contact, and places to climb from.

Where the data pin some entries given the others (`Coordinates.entries`), draws from all over the
prior whose entries are standard normal agree with the readings already: where enough of them stay
inside the prior's box, a few show where the posterior lies, however many pieces it has. But a
narrow mode is met by none of them, and where readings tell outlines apart hardly any stay. Modes
are therefore looked for from places where the entries are the best that the box allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Coordinates, Target
from tpcd.belief.modes import log_target
from tpcd.belief.resampling import effective_sample_size, systematic_resample
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.weights import TRUSTED, finite, known_weights, threshold

_AT_ONCE = 2000
_POWER = 0.3
"""Power of what the readings say about the rest, by which the first ones to be weighed are chosen:
they lie further apart than the posterior."""
_TRYING_POWER = 0.1
"""Power at most of what the readings say about the best entries, by which places are tried, and"""
_CLIMBING_POWER = 0.2
"""of the posterior there, by which those are chosen that climb. The basin of a narrow mode is far
below its top, and above its surroundings. Chosen, with the numbers of the closing draws, on six
recordings on which modes had been missed (eval/EVIDENCE.md, Calibration)."""
_WEAKER = 0.7
"""Factor between one power and the next."""


@dataclass(frozen=True, eq=False)
class FlatDraws:
    """Draws of all rounds, in flat coordinates."""

    flat: Float[Tensor, "n d"]
    log_target: Float[Tensor, " n"]
    """In flat coordinates, not normalised; -inf out of the box."""
    log_sum: Float[Tensor, " n"]
    """Log of the sum of the densities of all draws."""
    starts: int
    """How many draws from all over the prior were made for those among these."""

    @property
    def log_weights(self) -> Tensor:
        """But for a constant."""
        return finite(self.log_target - self.log_sum)

    @property
    def trusted(self) -> float:
        """A log weight that some draws reach; -inf where none has any."""
        if len(self.flat) == 0:
            return -math.inf
        return float(self.log_weights.topk(min(TRUSTED, len(self.flat))).values[-1])


@dataclass(frozen=True, eq=False)
class FlatStart:
    """What is known before the first round."""

    coordinates: Coordinates
    draws: FlatDraws
    """From all over the prior, where they agree with the readings in contact."""
    points: Float[Tensor, "f d"]
    """Scores from which to look for modes."""


def flat_starts(
    target: Target,
    coordinates: Coordinates,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> FlatStart:
    """Draws from all over the prior, few where the readings leave the boxes, and where to climb."""
    drawn, flat, score, log_slope = _inside(target, coordinates, settings, generator)
    log_prior = target.log_prior(score)
    log_sum = log_start(coordinates, flat, score, log_prior) + math.log(drawn)
    log_prior = finite(log_prior + log_slope)
    first = torch.arange(len(flat))
    if len(flat) > settings.fresh_modes:
        weights = known_weights(_POWER * coordinates.log_marginal(flat))
        first = systematic_resample(weights, settings.fresh_modes, generator).unique()
    log_target = torch.full_like(log_sum, -torch.inf)
    log_target[first] = finite(log_prior[first] + target.log_likelihood(score[first], None))
    draws = FlatDraws(flat, log_target, log_sum, drawn)
    if len(first) < len(flat):
        # Those first ones tell which of the others are worth weighing.
        least = threshold(draws.trusted, log_sum, log_prior)
        least[first] = torch.inf
        others = finite(log_prior + target.log_likelihood(score, least))
        draws = replace(draws, log_target=torch.maximum(log_target, others))
    return FlatStart(coordinates, draws, _climbers(target, coordinates, settings, generator))


def _climbers(
    target: Target,
    coordinates: Coordinates,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> Tensor:
    """Scores from which to look for modes: draws of the others, with the best entries."""
    score, likely = coordinates.likeliest(target.sample(settings.flat_starts, generator))
    weights = _tempered(likely, settings.flat_tried)
    tried = score[systematic_resample(weights, settings.flat_tried, generator).unique()]
    height = log_target(target, tried)
    if not bool((height > -torch.inf).any()):
        return tried[: settings.flat_climbers]
    weights = known_weights(_CLIMBING_POWER * height)
    return tried[systematic_resample(weights, settings.flat_climbers, generator).unique()]


def _tempered(log_weights: Tensor, count: int) -> Tensor:
    """Weights to the largest power, of those that are tried, with which they are worth at least
    half of so many draws, or of all there are."""
    power = _TRYING_POWER
    enough = 0.5 * min(count, int((log_weights > -torch.inf).sum()))
    weights = known_weights(power * log_weights)
    while effective_sample_size(weights) < enough:
        power *= _WEAKER
        weights = known_weights(power * log_weights)
    return weights


def _inside(
    target: Target,
    coordinates: Coordinates,
    settings: SamplerSettings,
    generator: torch.Generator,
) -> tuple[int, Tensor, Tensor, Tensor]:
    """Draws with standard normal entries that are in the boxes, until there are enough: how many
    were made, flat coordinates, scores, and log |d score / d flat|."""
    entries = list(coordinates.entries)
    parts, drawn, found = [], 0, 0
    while drawn < settings.flat_starts and found < settings.flat_enough:
        count = min(_AT_ONCE, settings.flat_starts - drawn)
        flat = target.sample(count, generator)
        size = (count, len(entries))
        flat[:, entries] = torch.randn(size, generator=generator, dtype=flat.dtype)
        score, log_slope = coordinates.to_score(flat)
        inside = torch.isfinite(score).all(-1)
        parts.append((flat[inside], score[inside], log_slope[inside]))
        drawn, found = drawn + count, found + int(inside.sum())
    flat, score, log_slope = (torch.cat(column) for column in zip(*parts, strict=True))
    return drawn, flat, score, log_slope


def log_start(
    coordinates: Coordinates,
    flat: Float[Tensor, "m d"],
    score: Float[Tensor, "m d"],
    log_prior: Float[Tensor, " m"],
) -> Float[Tensor, " m"]:
    """Log density in flat coordinates of the rest from the prior, and standard normal entries."""
    own, e = (value[:, list(coordinates.entries)] for value in (score, flat))
    return log_prior + 0.5 * (own**2 - e**2).sum(-1)
