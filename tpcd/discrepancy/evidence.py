"""How well a model explains a history: its evidence and posterior, from the prior, on some seeds.

Every model is fitted in the same way and with the same budget: importance sampling of the whole
history at once, with modes found by climbing from all over the prior. Parameters of effects are
entries of theta like all others, so effects and shape, mount, floor, wall and friction compete
for the same data.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief, belief_of
from tpcd.belief.cloud import Cloud, SamplerSettings, start_cloud
from tpcd.belief.history import History
from tpcd.belief.importance import draw_pool
from tpcd.belief.misfit import MisfitField
from tpcd.belief.modes import find_modes
from tpcd.belief.pool import known_weights, truncate
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.resampling import systematic_resample
from tpcd.belief.state import STATE_VERSION
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.memory import Memory, digest
from tpcd.effects.protocol import Effect
from tpcd.random import stream
from tpcd.simulator import StepSettings

FIT_SAMPLER = SamplerSettings(particles=300, draws=2000, prior_draws=500)
"""Budget of one fit on one seed."""
_REMEMBERED = 12
"""Places of an earlier fit that a new one starts from as well."""
STAGES = (0.2, 0.5)
"""Shares of the transitions on which modes are sought first."""
TIED = 8.0
"""Seeds whose log evidence is so close to the best count alike."""
_WITHIN = 2.5
"""A null value at the end of a prior is started from within so many standard scores."""


@dataclass(frozen=True)
class Question:
    """What every model is asked: the same data, prior of the scene and budget."""

    history: History
    scene: ParameterPrior
    misfit: MisfitField
    step: StepSettings
    sampler: SamplerSettings = FIT_SAMPLER
    seed: int = 0
    memory: Memory = Memory()
    """Where fits are kept."""

    @cached_property
    def fingerprint(self) -> str:
        """Of all that answers depend on."""
        history, scene = self.history, self.scene
        return digest(
            STATE_VERSION,
            *(history.commands, history.readings, history.sensor_variance, history.stiffness),
            *(history.used, history.seams, history.parity_counts, scene.low, scene.high),
            *(type(scene.shape).__name__, scene.shape.latent_dim, scene.shape.misfit_sd),
            *(self.misfit, self.step, self.sampler, self.seed),
        )


@dataclass(frozen=True)
class Fit:
    """A model with its evidence on each seed, and its posterior."""

    effects: tuple[Effect, ...]
    step: StepSettings
    prior: ParameterPrior
    by_seed: tuple[float, ...]
    """Log evidence on each seed."""
    clouds: tuple[Cloud, ...]
    """Particles of each seed."""

    @cached_property
    def cloud(self) -> Cloud:
        """Particles of all seeds together."""
        return _joined(self.clouds)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def fingerprint(self) -> str:
        """Of the model and what was found."""
        bounds = (self.prior.low, self.prior.high)
        return digest(self.names, self.by_seed, self.step, *bounds, self.cloud.positions)

    @property
    def log_evidence(self) -> float:
        """Logarithm of the mean evidence of the seeds."""
        return _log_mean(self.by_seed)

    @property
    def spread(self) -> float:
        """Largest difference of the log evidence between seeds; infinite for a single one."""
        return max(self.by_seed) - min(self.by_seed) if len(self.by_seed) > 1 else math.inf


def fit_model(
    question: Question,
    effects: Sequence[Effect],
    seeds: Sequence[int],
    start: Sequence[Fit] = (),
    step: StepSettings | None = None,
    places: Float[Tensor, "k s"] | None = None,
    power: float = 1.0,
) -> Fit:
    """Fit the base model with these effects; seeds are told apart by their numbers.

    Besides the prior, a fit also starts from where those in `start` arrived, and from `places`.
    With a `power` of the likelihood below 1 the posterior is wider, and what stands for its
    evidence is none.
    """
    effects = tuple(effects)
    prior = question.scene.with_effects(effects)
    step = question.step if step is None else step
    target = ContactTarget(prior, question.misfit, step, question.history, power)
    names = tuple(effect.name for effect in effects)
    model = (question.fingerprint, names, prior.low, prior.high, step, power)
    begun = tuple(fit.fingerprint for fit in start)
    clouds = []
    for seed in seeds:
        generator = fit_stream(question, effects, seed)

        def work(generator: torch.Generator = generator) -> Cloud:
            return _fitted(target, question.sampler, start, places, generator)

        clouds.append(question.memory.recall((*model, begun, places, seed), Cloud, work))
    return Fit(effects, step, prior, tuple(c.log_evidence for c in clouds), tuple(clouds))


def _fitted(
    target: ContactTarget,
    sampler: SamplerSettings,
    start: Sequence[Fit],
    places: Float[Tensor, "k s"] | None,
    generator: torch.Generator,
) -> Cloud:
    """The particles of one seed."""
    begin = start_cloud(target.sample(sampler.particles, generator))
    remembered = [carried(fit, target.prior, generator) for fit in start]
    remembered.append(_early_modes(target, sampler, generator))
    if places is not None:
        remembered.append(places)
    begin = replace(begin, modes=torch.cat(remembered))
    pool = draw_pool(begin, target, 1, sampler, generator)
    weights = truncate(known_weights(pool.log_weights))
    index, counts = systematic_resample(weights, sampler.particles, generator).unique(
        return_counts=True
    )
    return Cloud(
        pool.positions[index],
        counts.double() / sampler.particles,
        pool.log_likelihood[index],
        pool.log_evidence,
        pool.log_evidence_std,
        pool.modes,
        pool.shares,
    )


def _early_modes(
    target: ContactTarget, sampler: SamplerSettings, generator: torch.Generator
) -> Float[Tensor, "k s"]:
    """Modes carried from a short history to longer ones: the first transitions leave fewer ways
    to be stuck than all of them."""
    assert target.history is not None
    modes = torch.zeros(0, target.prior.dimension + 1, dtype=torch.float64)
    if sampler.fresh_modes == 1:
        return modes
    for share in STAGES:
        count = max(1, round(share * len(target.history)))
        modes = find_modes(
            target.given(target.history.first(count)), modes, sampler, generator
        ).points
    return modes


def joined_fit(one: Fit, other: Fit) -> Fit:
    """Two fits of one model on different seeds as one."""
    return replace(one, by_seed=one.by_seed + other.by_seed, clouds=one.clouds + other.clouds)


def posterior(question: Question, fit: Fit) -> Belief:
    """The belief of a fit, which predicts."""
    target = ContactTarget(fit.prior, question.misfit, fit.step, question.history)
    return belief_of(fit.cloud, target)


def fit_stream(question: Question, effects: Sequence[Effect], seed: int) -> torch.Generator:
    """Random numbers of their own for every model and seed."""
    name = "+".join(effect.name for effect in effects)
    return stream(question.seed, zlib.crc32(name.encode()), seed)


def carried(
    fit: Fit,
    prior: ParameterPrior,
    generator: torch.Generator,
    count: int = _REMEMBERED,
    repeat: bool = False,
) -> Float[Tensor, "k s"]:
    """At most `count` places of a fit in the coordinates of another model, with `repeat` so many
    in any case: effects that both have are kept, new ones start at their null value and at draws
    from their prior."""
    best = fit.cloud.weights.argsort(descending=True)[:count]
    if repeat:  # two in a row, so that both kinds of start are made of each
        best = best[(torch.arange(count) // 2) % len(best)]
    places = fit.cloud.positions[best]
    scene = prior.scene_dimension
    columns = [_rescaled(places[:, :scene], fit.prior, prior)]
    own = dict(zip(fit.prior.names[scene:], places[:, scene:-1].T, strict=True))
    null = torch.cat((prior.low[:scene], _null(prior)))
    null_score = prior.to_score(null)[scene:].clamp(-_WITHIN, _WITHIN)
    for k, name in enumerate(prior.names[scene:]):
        drawn = torch.randn(len(places), generator=generator, dtype=torch.float64)
        drawn[::2] = null_score[k]
        columns.append(own.get(name, drawn)[:, None])
    return torch.cat((*columns, places[:, -1:]), dim=-1)


def _rescaled(
    score: Float[Tensor, "k d"], before: ParameterPrior, now: ParameterPrior
) -> Float[Tensor, "k d"]:
    """Coordinates of the scene where the prior of some entries is another one."""
    scene = slice(0, score.shape[-1])
    (low, high), (least, most) = ((p.low[scene], p.high[scene]) for p in (before, now))
    if torch.equal(low, least) and torch.equal(high, most):
        return score
    place = low + (high - low) * torch.special.ndtr(score)
    share = ((place - least) / (most - least)).clamp(1e-9, 1 - 1e-9)
    return torch.where((low == least) & (high == most), score, torch.special.ndtri(share))


def _null(prior: ParameterPrior) -> Tensor:
    values = [p.null for effect in prior.effects for p in effect.parameters]
    return torch.tensor(values, dtype=torch.float64)


def _joined(clouds: Sequence[Cloud]) -> Cloud:
    """Clouds of one target as one.

    Differences of evidence between seeds are mostly noise of the sampler, and each seed has few
    draws that count, all in one place. Seeds near the best therefore count alike, which keeps
    what they disagree about in the posterior.
    """
    evidence = [cloud.log_evidence for cloud in clouds]
    found = torch.tensor(evidence, dtype=torch.float64)
    share = (found - found.max() + TIED).clamp(-math.inf, 0.0).softmax(0)
    weights = torch.cat([s * cloud.weights for s, cloud in zip(share, clouds, strict=True)])
    positions = torch.cat([cloud.positions for cloud in clouds])
    likelihood = torch.cat([cloud.log_likelihood for cloud in clouds])
    kept = weights > 1e-6
    best = clouds[int(share.argmax())]
    return replace(
        best,
        positions=positions[kept],
        weights=weights[kept] / weights[kept].sum(),
        log_likelihood=likelihood[kept],
        log_evidence=_log_mean(evidence),
        modes=torch.cat([cloud.modes for cloud in clouds]),
    )


def _log_mean(values: Sequence[float]) -> float:
    found = torch.tensor(values, dtype=torch.float64)
    return float(torch.logsumexp(found, 0)) - math.log(len(values))
