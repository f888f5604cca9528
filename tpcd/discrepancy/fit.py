"""A question that every model is asked, and a model's answer: its evidence and its posterior."""

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
from tpcd.belief.cloud import Cloud
from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.state import STATE_VERSION
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.memory import Memory, digest
from tpcd.effects.protocol import Effect
from tpcd.random import stream
from tpcd.simulator import StepSettings

FIT_SAMPLER = SamplerSettings(
    particles=300,
    places=60,
    draws_per_place=6,
    rounds=1,
    draws=1500,
    flat_rounds=4,
    flat_worth=60.0,
    flat_starts=4000,
    flat_enough=1000,
    flat_tried=600,
    flat_climbers=60,
    flat_draws=400,
    rough=False,
    prior_draws=100,
    modes=16,
    fresh_modes=20,
)
"""Budget of one fit on one seed."""
TIED = 8.0
"""Seeds whose log evidence is so close to the best count alike in the posterior."""
MISSED = 3.0
"""A seed whose log evidence is so far below the best one has missed what that one found, and does
not count in the evidence: models are fitted on different numbers of seeds."""


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
            *(type(scene.shape).__name__, scene.shape.latent_dim, scene.shape.misfit),
            getattr(scene.shape, "card", {}).get("weights_sha256"),
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
        """Particles of all seeds together, as a posterior is reported.

        Differences of evidence between seeds are mostly noise of the sampler, and each seed has few
        draws that count, all in one place. Seeds near the best therefore count alike, which keeps
        what they disagree about in the posterior.
        """
        found = torch.tensor(self.by_seed, dtype=torch.float64)
        return _joined(self.clouds, (found - found.max() + TIED).clamp(-math.inf, 0.0))

    @cached_property
    def cloud_by_evidence(self) -> Cloud:
        """The same as `log_evidence` has it: each seed by its own evidence, and none that has
        missed what the best one found."""
        found = torch.tensor(self.by_seed, dtype=torch.float64)
        kept = found >= found.max() - MISSED
        return _joined(self.clouds, torch.where(kept, found, -torch.inf))

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
        """Logarithm of the mean evidence of the seeds that found what the best one did."""
        return _log_mean(self.by_seed)

    @property
    def worth(self) -> float:
        """Effective number of the draws that the posterior was chosen from."""
        std = self.cloud.log_evidence_std
        return std**-2 if std > 0 else math.inf

    @property
    def spread(self) -> float:
        """Largest difference of the log evidence between seeds; infinite for a single one."""
        return max(self.by_seed) - min(self.by_seed) if len(self.by_seed) > 1 else math.inf


def joined_fit(one: Fit, other: Fit) -> Fit:
    """Two fits of one model on different seeds as one."""
    return replace(one, by_seed=one.by_seed + other.by_seed, clouds=one.clouds + other.clouds)


def posterior(question: Question, fit: Fit) -> Belief:
    """The belief of a fit, which predicts."""
    target = ContactTarget(fit.prior, question.misfit, fit.step, question.history)
    return belief_of(fit.cloud, target)


def model_name(effects: Sequence[Effect]) -> str:
    """What to call the base model with these effects."""
    return " + ".join(effect.name for effect in effects) or "the base model"


def fit_stream(question: Question, effects: Sequence[Effect], seed: int) -> torch.Generator:
    """Random numbers of their own for every model and seed."""
    name = "+".join(effect.name for effect in effects)
    return stream(question.seed, zlib.crc32(name.encode()), seed)


def _joined(clouds: Sequence[Cloud], log_share: Float[Tensor, " k"]) -> Cloud:
    """Clouds of one target as one, in which each has such a share."""
    evidence = [cloud.log_evidence for cloud in clouds]
    share = log_share.softmax(0)
    weights = torch.cat([s * cloud.weights for s, cloud in zip(share, clouds, strict=True)])
    stds = torch.tensor([cloud.log_evidence_std for cloud in clouds], dtype=torch.float64)
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
        log_evidence_std=float((share * stds).norm()),
        modes=torch.cat([cloud.modes for cloud in clouds]),
    )


def _log_mean(values: Sequence[float]) -> float:
    found = torch.tensor(values, dtype=torch.float64)
    kept = found[found >= found.max() - MISSED]
    if not len(kept):  # not a number
        return float(found.max())
    return float(torch.logsumexp(kept, 0)) - math.log(len(kept))
