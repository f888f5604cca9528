"""The belief over theta: estimated from an episode, held by users, saved and loaded.

`estimate` brings in the transitions of an episode one by one and yields the belief after
each (the last one gets more draws in `refinement`). A belief holds weighted particles of theta
and, for each particle, the normal posterior of the outline misfit; it is all that prediction
needs besides the shape model.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import (
    Cloud,
    CloudInfo,
    cloud_from_tensors,
    cloud_to_tensors,
    start_cloud,
)
from tpcd.belief.free_start import rests_free, start_gaps
from tpcd.belief.history import history_of
from tpcd.belief.importance import assimilate
from tpcd.belief.likelihood import effective_setting
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.resampling import effective_sample_size, weighted_quantile
from tpcd.belief.settings import EstimatorSettings
from tpcd.belief.state import EstimatorState
from tpcd.belief.target import ContactTarget
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings
from tpcd.threads import torch_in_one_thread

_SOME_FREE = 1e-3
"""Where no draw is free at the start with this probability, they are not weighted by it."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Weighted particles of theta with the misfit of the outline marginalised, m particles."""

    prior: ParameterPrior
    vectors: Float[Tensor, "m d"]
    """Theta in SI units, in the order of `prior.names`."""
    weights: Float[Tensor, " m"]
    """Weights that sum to 1."""
    misfit: MisfitField
    misfit_sd: Float[Tensor, " m"]
    """Standard deviation of the outline misfit that each particle holds for true [m]."""
    misfit_mean: Float[Tensor, "m c"]
    """Mean of the misfit coefficients given each particle [m]."""
    misfit_covariance: Float[Tensor, "m c c"]
    """Their covariance [m^2]."""
    step: StepSettings
    stiffness: Float[Tensor, " 3"]
    log_evidence: float
    log_evidence_std: float
    """Its standard error over the draws."""

    @property
    def parameters(self) -> Parameters:
        """The particles as named tensors."""
        return self.prior.parameters_of(self.vectors)

    def mean(self) -> Float[Tensor, " d"]:
        """Posterior mean of theta."""
        return self.weights @ self.vectors

    @property
    def effective_sample_size(self) -> float:
        """How many independent draws from the posterior the particles are worth: Kish's number of
        their weights, or of the draws that they were chosen from, by the error of the evidence."""
        own = effective_sample_size(self.weights)
        if not self.log_evidence_std > 0:
            return own
        return min(own, self.log_evidence_std**-2)

    def quantile(self, level: float) -> Float[Tensor, " d"]:
        """Quantile of every entry of theta, further out where the particles are worth few draws."""
        return self.quantile_of(self.vectors, level)

    def quantile_of(
        self, values: Float[Tensor, " m *columns"], level: float
    ) -> Float[Tensor, "*columns"]:
        """The same of anything that the particles have a value of."""
        return weighted_quantile(values, self.weights, level, self.effective_sample_size)

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
    state: EstimatorState
    """What the estimator needs to go on from here."""


def estimate(
    episode: Episode,
    shape: Shape,
    generator: torch.Generator,
    settings: EstimatorSettings | None = None,
    state: EstimatorState | None = None,
) -> Iterator[EstimationStep]:
    """Estimate theta from the transitions of an episode, yielding the belief after each one.

    The episode's own priors replace the defaults. With the `state` of an earlier step of the
    same estimation it goes on after that step. Raises ValueError where no particle can
    explain a transition, and for rows that are not finite.
    """
    settings = settings or EstimatorSettings()
    episode.check_learnable()
    history = history_of(episode)
    target = target_of(episode, shape, settings)
    if state is None:
        cloud = start_cloud(target.sample(settings.sampler.particles, generator))
    else:
        cloud = cloud_from_tensors(state.restore(generator))
    for k in range(1 if state is None else state.index + 1, len(history) + 1):
        started = time.perf_counter()
        target = target.given(history.first(k))
        cloud, info = assimilate(cloud, target, k, settings.budget, generator)
        belief = belief_of(cloud, target)
        seconds = time.perf_counter() - started
        after = EstimatorState(k, cloud_to_tensors(cloud), generator.get_state())
        yield EstimationStep(k, belief, info, seconds, after)


def target_of(episode: Episode, shape: Shape, settings: EstimatorSettings) -> ContactTarget:
    """The posterior to sample from, still without data."""
    prior = make_prior(shape, settings.shape.bounds(episode.priors), settings.effects)
    field, power = misfit_field(shape, settings), settings.likelihood_power
    return ContactTarget(prior, field, settings.step, power=power)


def prior_belief(
    episode: Episode,
    shape: Shape,
    generator: torch.Generator,
    settings: EstimatorSettings | None = None,
) -> Belief:
    """The belief before any transition: draws from the prior, weighted by how likely they leave a
    start pose free that bears no load.

    Where it bears one, or none of the draws leaves it free, all of them alike.
    """
    settings = settings or EstimatorSettings()
    episode.check_learnable()
    target = target_of(episode, shape, settings)
    prior, misfit = target.prior, target.misfit
    score = target.sample(settings.sampler.particles, generator)
    vectors, sd = prior.to_vector(score[:, :-1]), misfit.sd_of(score[:, -1])
    scene = scene_from_parameters(shape, prior.parameters_of(vectors)).double()
    history = history_of(episode)
    setting, added = history.setting(scene), prior.added_of(vectors)
    if added.effects:
        setting, _ = effective_setting(scene, history, sd, misfit, settings.step, added)
    starts = start_gaps(scene.points_ee, setting, history.poses[:, 2], torch.tensor([0]))
    free = starts.log_free_before(misfit, sd).exp()
    tells = bool(rests_free(history)[0]) and float(free.max()) > _SOME_FREE
    weights = free if tells else torch.ones_like(free)
    size = misfit.bumps * len(scene.terrains)
    return Belief(
        prior=prior,
        vectors=vectors,
        weights=of_valid_shapes(prior, vectors, weights / weights.sum()),
        misfit=misfit,
        misfit_sd=sd,
        misfit_mean=torch.zeros(len(sd), size, dtype=torch.float64),
        misfit_covariance=torch.diag_embed((sd**2)[:, None].expand(-1, size)),
        step=settings.step,
        stiffness=episode.stiffness.double(),
        log_evidence=0.0,
        log_evidence_std=0.0,
    )


def misfit_field(shape: Shape, settings: EstimatorSettings) -> MisfitField:
    """The misfit field that belongs to a shape model."""
    own, sd, spread = shape.misfit, settings.misfit_sd, settings.misfit_spread
    factor = settings.shape.misfit if sd is None else 1.0
    if spread is None:
        measured = own.spread if sd is None else 0.0
        spread = max(measured, settings.least_misfit_spread)
    if sd is None:
        sd = own.sd
    return MisfitField(
        sd=factor * max(sd, settings.least_misfit_sd),
        spread=spread,
        width=own.width,
        grain=own.grain,
        roughness=own.roughness,
    )


def of_valid_shapes(
    prior: ParameterPrior, vectors: Float[Tensor, "m d"], weights: Float[Tensor, " m"]
) -> Float[Tensor, " m"]:
    """The weights, zero where the latent does not decode to one closed outline. Where no other is
    left they stay as they are, and a warning says so."""
    valid = prior.shape.valid(vectors[:, : prior.shape.latent_dim])
    if bool(valid.all()):
        return weights
    kept = torch.where(valid, weights, torch.zeros_like(weights))
    if not bool(kept.sum() > 0):
        warnings.warn(
            "none of the particles decodes to one closed outline: this prior does not know such an "
            "object, and its outline is not to be trusted",
            stacklevel=2,
        )
        return weights
    return kept / kept.sum()


@torch_in_one_thread
def belief_of(cloud: Cloud, target: ContactTarget) -> Belief:
    """The belief that weighted particles stand for, given the history of the target."""
    assert target.history is not None
    found = target.evaluate(cloud.positions)
    vectors = target.prior.to_vector(cloud.positions[:, :-1])
    return Belief(
        prior=target.prior,
        vectors=vectors,
        weights=of_valid_shapes(target.prior, vectors, cloud.weights),
        misfit=target.misfit,
        misfit_sd=target.misfit.sd_of(cloud.positions[:, -1]),
        misfit_mean=found.field_mean,
        misfit_covariance=found.field_covariance,
        step=target.step,
        stiffness=target.history.stiffness,
        log_evidence=cloud.log_evidence,
        log_evidence_std=cloud.log_evidence_std,
    )
