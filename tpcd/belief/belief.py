"""The belief over theta: estimated from an episode, held by users, saved and loaded.

`estimate` brings in the transitions of an episode one by one and yields the belief after
each. A belief holds weighted particles of theta and, for each particle, the normal
posterior of the outline misfit; it is all that prediction needs besides the shape model.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.history import History, history_of
from tpcd.belief.likelihood import HistoryLikelihood, history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.smc import Cloud, CloudInfo, SamplerSettings, assimilate, start_cloud
from tpcd.data.episode import Episode
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings


@dataclass(frozen=True)
class EstimatorSettings:
    """Choices of the default estimator."""

    sampler: SamplerSettings = field(default_factory=SamplerSettings)
    """Budget of the sampler."""
    step: StepSettings = field(default_factory=StepSettings)
    """The quasi-static model."""
    misfit_sd: float | None = None
    """Standard deviation of the outline misfit [m]; None takes the shape model's own figure."""
    misfit_width: float = 0.15
    """How far the object turns until the outline error is another one [rad]."""
    least_misfit_sd: float = 1e-4
    """The misfit is never taken to be less than this [m]."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Weighted particles of theta with the misfit of the outline marginalised, m particles."""

    prior: ParameterPrior
    vectors: Float[Tensor, "m d"]
    """Theta in SI units, in the order of `prior.names`."""
    weights: Float[Tensor, " m"]
    """Weights that sum to 1."""
    misfit: MisfitField
    misfit_mean: Float[Tensor, "m c"]
    """Mean of the misfit coefficients given each particle [m]."""
    misfit_precision: Float[Tensor, "m c c"]
    """Their precision [1/m^2]."""
    step: StepSettings
    stiffness: Float[Tensor, " 3"]
    log_evidence: float
    log_evidence_std: float

    @property
    def parameters(self) -> Parameters:
        """The particles as named tensors."""
        return Parameters.from_vector(self.vectors)

    def mean(self) -> Float[Tensor, " d"]:
        """Posterior mean of theta."""
        return self.weights @ self.vectors

    def quantile(self, level: float) -> Float[Tensor, " d"]:
        """Weighted quantile of every entry of theta."""
        ordered, order = self.vectors.sort(dim=0)
        cumulative = self.weights[order].cumsum(0)
        first = (cumulative >= level * cumulative[-1]).double().argmax(0)
        return ordered.gather(0, first[None])[0]

    def std(self) -> Float[Tensor, " d"]:
        """Posterior standard deviation of every entry of theta."""
        centred = self.vectors - self.mean()
        return (self.weights @ centred**2).sqrt()


@dataclass(frozen=True)
class EstimationStep:
    """What one datum did: the belief after it, what it cost, and how the sampler fared."""

    index: int
    belief: Belief
    info: CloudInfo
    seconds: float


def estimate(
    episode: Episode,
    shape: Shape,
    generator: torch.Generator,
    settings: EstimatorSettings | None = None,
) -> Iterator[EstimationStep]:
    """Estimate theta from the transitions of an episode, yielding the belief after each one.

    The episode's own priors replace the defaults. Raises ValueError where no particle can
    explain a transition.
    """
    settings = settings or EstimatorSettings()
    prior = make_prior(shape, episode.priors)
    history = history_of(episode)
    misfit = misfit_field(shape, settings)
    cloud = start_cloud(prior.sample(settings.sampler.particles, generator), prior.log_density)
    for k in range(1, len(history) + 1):
        started = time.perf_counter()
        so_far = history.first(k)

        def log_likelihood(score: Tensor, so_far: History = so_far) -> tuple[Tensor, Tensor]:
            found = _evaluate(prior, score, so_far, misfit, settings)
            return found.before, found.total

        cloud, info = assimilate(
            cloud, prior.log_density, log_likelihood, settings.sampler, generator
        )
        belief = _belief(prior, cloud, so_far, misfit, settings)
        yield EstimationStep(k, belief, info, time.perf_counter() - started)


def misfit_field(shape: Shape, settings: EstimatorSettings) -> MisfitField:
    """The misfit field that belongs to a shape model."""
    sd = shape.misfit_sd if settings.misfit_sd is None else settings.misfit_sd
    return MisfitField(sd=max(sd, settings.least_misfit_sd), width=settings.misfit_width)


def _evaluate(
    prior: ParameterPrior,
    score: Tensor,
    history: History,
    misfit: MisfitField,
    settings: EstimatorSettings,
) -> HistoryLikelihood:
    return history_likelihood(
        prior.shape, prior.to_parameters(score), history, misfit, settings.step
    )


def _belief(
    prior: ParameterPrior,
    cloud: Cloud,
    history: History,
    misfit: MisfitField,
    settings: EstimatorSettings,
) -> Belief:
    found = _evaluate(prior, cloud.positions, history, misfit, settings)
    count = len(cloud.positions)
    return Belief(
        prior=prior,
        vectors=prior.to_vector(cloud.positions),
        weights=torch.full((count,), 1.0 / count, dtype=torch.float64),
        misfit=misfit,
        misfit_mean=found.field_mean,
        misfit_precision=found.field_precision,
        step=settings.step,
        stiffness=history.stiffness,
        log_evidence=cloud.log_evidence,
        log_evidence_std=cloud.log_evidence_std,
    )
