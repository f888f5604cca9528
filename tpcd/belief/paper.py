"""The particle filter of Kim, Zhu and Dollar (arXiv 2409.17470), Algorithm 1, for comparison.

M particles start from the prior. With datum k, every particle is weighted by a window of the
last N data: w is multiplied, for each datum i in the window, by exp(-1/2 e^T R^-1 e) with
e = (wrench and pose measured at row i) - f_theta(pose measured at row i - 1, command i) and
R = diag(30 N, 30 N, 0.3 N·m, 1e-4 m, 1e-4 m, 0.002 rad), whose numbers are read as the
covariance. When n_eff = 1 / sum w^2 <= M / 2 the particles are resampled and roughened with
normal noise of standard deviation K E M^(-1/d), with E the spread (largest less smallest) of
each entry of theta and K = 0.3 (Gordon, Salmond and Smith 1993).

Departures from the text, and what it leaves open:
- n_eff is printed there without the inverse, as sum w^2 <= M / 2; that holds always, so that
  the filter would resample at every step and collapse. The usual number is used.
- Its inner loop multiplies the weight of the step before in once for each datum of the
  window, w <- w_old L_i. That would raise old weights to the N-th power; here each step
  multiplies w_old once, with the product of the window.
- What is kept as written: a datum enters up to N times while it is in the window. The
  posterior is too narrow for that; it is the paper's choice, and the reason why it is not
  the default here.
- Normalisation in the log domain; resampling is systematic (the text does not say).
- Noise that carries an entry out of its box is reflected at the wall. A latent whose
  roughened place has no prior density stays at its place before. After the last datum, latents
  that do not decode to one closed outline get weight zero; to ask that of all particles at each
  datum would double the time of a step.
- A particle whose step fails, or is not finite, gets weight zero.
- The weights of the filter do not estimate the evidence; that of its beliefs is NaN.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief, EstimationStep, of_valid_shapes
from tpcd.belief.cloud import CloudInfo
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.resampling import (
    effective_sample_size,
    normalise_log_weights,
    systematic_resample,
)
from tpcd.belief.state import EstimatorState
from tpcd.contact import column_scene, scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.planar import wrap_angle
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, simulate_step

PAPER_STEP = StepSettings(friction="anitescu", substeps=2, finest=1.0)
"""The convex friction of the paper."""


@dataclass(frozen=True)
class PaperSettings:
    """The configuration `paper`; the defaults are the paper's numbers."""

    particles: int = 5000
    """Particles M."""
    memory: int = 5
    """Data N in the window."""
    covariance: tuple[float, ...] = (30.0, 30.0, 0.3, 1e-4, 1e-4, 0.002)
    """Diagonal of R for F_x, F_z [N^2], tau [N^2 m^2], x, z [m^2], phi [rad^2]."""
    roughness: float = 0.3
    """K of the roughening; 0 switches it off."""
    resampling_share: float = 0.5
    """Resample when the effective sample size is at most this share of M."""
    step: StepSettings = field(default_factory=lambda: PAPER_STEP)
    """The quasi-static model."""

    def __post_init__(self) -> None:
        """Refuse settings without meaning."""
        if not (self.particles >= 2 and self.memory >= 1):
            raise ValueError(
                f"particles {self.particles} must be >= 2 and memory {self.memory} >= 1"
            )
        if len(self.covariance) != 6 or not all(0 < one < math.inf for one in self.covariance):
            raise ValueError(f"covariance is {self.covariance}, expected six positive numbers")
        if not 0 <= self.roughness < math.inf or not 0 <= self.resampling_share <= 1:
            raise ValueError(
                f"roughness {self.roughness} must be >= 0 and resampling_share "
                f"{self.resampling_share} in [0, 1]"
            )


def estimate_paper(
    episode: Episode,
    shape: Shape,
    generator: torch.Generator,
    settings: PaperSettings | None = None,
    state: EstimatorState | None = None,
) -> Iterator[EstimationStep]:
    """Run the filter over an episode, yielding the belief after each transition.

    The episode's own priors replace the defaults; the latent is uniform where the shape
    model's density is positive. Beliefs carry no misfit field and no evidence (NaN). In `info`,
    `rounds` counts resamplings (0 or 1), and `distinct` the particles of the step before that
    have descendants. With the `state` of an earlier step it goes on after
    that step. Raises ValueError where no particle explains the data.
    """
    settings = settings or PaperSettings()
    episode.check_learnable()
    prior = make_prior(shape, episode.priors)
    count = settings.particles
    if state is None:
        vectors = _draw_prior(prior, count, generator)
        log_weights = torch.zeros(count, dtype=torch.float64)
    else:
        kept = state.restore(generator)
        vectors, log_weights = kept["vectors"], kept["log_weights"]
    for k in range(1 if state is None else state.index + 1, len(episode)):
        started = time.perf_counter()
        first = max(1, k - settings.memory + 1)
        likelihood = window_log_likelihood(prior, vectors, episode, first, k, settings)
        weights = normalise_log_weights(log_weights + likelihood)
        effective = effective_sample_size(weights)
        ancestors, resampled = torch.arange(count), effective <= settings.resampling_share * count
        if resampled:
            ancestors = systematic_resample(weights, count, generator)
            vectors = _roughen(prior, vectors[ancestors], settings.roughness, generator)
            weights = torch.full((count,), 1.0 / count, dtype=torch.float64)
        log_weights = weights.log()
        info = CloudInfo(
            rounds=int(resampled),
            draws=0,
            effective_sample_size=effective,
            tail_shape=math.nan,
            distinct=int(ancestors.unique().numel()),
            evaluations=count,
        )
        last = k + 1 == len(episode)
        shown = of_valid_shapes(prior, vectors, weights) if last else weights
        belief = _belief(prior, vectors, shown, episode, settings)
        seconds = time.perf_counter() - started
        kept = {"vectors": vectors, "log_weights": log_weights}
        after = EstimatorState(k, kept, generator.get_state())
        yield EstimationStep(k, belief, info, seconds, after)


def paper_prior_belief(
    episode: Episode,
    shape: Shape,
    generator: torch.Generator,
    settings: PaperSettings | None = None,
) -> Belief:
    """The filter's belief before any transition."""
    settings = settings or PaperSettings()
    episode.check_learnable()
    prior = make_prior(shape, episode.priors)
    vectors = _draw_prior(prior, settings.particles, generator)
    even = torch.full((settings.particles,), 1.0 / settings.particles, dtype=torch.float64)
    return _belief(prior, vectors, even, episode, settings)


def window_log_likelihood(
    prior: ParameterPrior,
    vectors: Float[Tensor, "m d"],
    episode: Episode,
    first: int,
    last: int,
    settings: PaperSettings,
) -> Float[Tensor, " m"]:
    """Log of the product of exp(-1/2 e^T R^-1 e) over rows first..last; -inf where a step fails."""
    parameters = prior.parameters_of(vectors)
    scene = column_scene(scene_from_parameters(prior.shape, parameters))
    rows, before = slice(first, last + 1), slice(first - 1, last)
    transition = simulate_step(
        scene,
        episode.poses[before],
        episode.commands[rows],
        episode.stiffness,
        settings.step,
        previous=episode.commands[before],
        unusual=True,
    )
    pose = episode.poses[rows] - transition.pose
    pose = torch.cat((pose[..., :2], wrap_angle(pose[..., 2:])), dim=-1)
    error = torch.cat((episode.wrenches[rows] - transition.wrench, pose), dim=-1)
    covariance = torch.tensor(settings.covariance, dtype=torch.float64)
    each = -0.5 * (error**2 / covariance).sum(-1)
    usable = (transition.status <= int(StepStatus.RELAXED)) & torch.isfinite(each)
    usable = usable & torch.isfinite(vectors).all(-1, keepdim=True)
    return torch.where(usable, each, -torch.inf).sum(-1)


def roughening_std(vectors: Float[Tensor, "m d"], roughness: float) -> Float[Tensor, " d"]:
    """Standard deviation K E M^(-1/d) of the roughening of each entry (Gordon et al. 1993)."""
    count, d = vectors.shape
    spread = vectors.max(0).values - vectors.min(0).values
    return roughness * spread * count ** (-1.0 / d)


def reflect(
    vectors: Float[Tensor, "m d"], low: Float[Tensor, " d"], high: Float[Tensor, " d"]
) -> Float[Tensor, "m d"]:
    """Fold entries back into their box [low, high] as by mirrors at its walls."""
    width = high - low
    place = torch.remainder(vectors - low, 2 * width)
    return low + torch.minimum(place, 2 * width - place)


def _roughen(
    prior: ParameterPrior, vectors: Tensor, roughness: float, generator: torch.Generator
) -> Tensor:
    noise = torch.randn(vectors.shape, generator=generator, dtype=torch.float64)
    moved = reflect(vectors + roughening_std(vectors, roughness) * noise, prior.low, prior.high)
    z = prior.shape.latent_dim
    dense = prior.shape.log_density(moved[:, :z]) > -torch.inf
    latent = torch.where(dense[:, None], moved[:, :z], vectors[:, :z])
    return torch.cat((latent, moved[:, z:]), dim=-1)


def _draw_prior(prior: ParameterPrior, count: int, generator: torch.Generator) -> Tensor:
    """Uniform draws from the box of theta with valid latents, by rejection."""
    z, d = prior.shape.latent_dim, prior.dimension
    kept = torch.zeros(0, d, dtype=torch.float64)
    for _ in range(1000):
        uniform = torch.rand(count, d, generator=generator, dtype=torch.float64)
        draws = prior.low + (prior.high - prior.low) * uniform
        kept = torch.cat((kept, draws[prior.shape.log_density(draws[:, :z]) > -torch.inf]))
        if len(kept) >= count:
            return kept[:count]
    raise ValueError(
        f"fewer than 1 in 1000 latents of the box are valid ({len(kept)} found), too few for a "
        "uniform prior; use the default estimator with this shape model"
    )


def _belief(
    prior: ParameterPrior,
    vectors: Tensor,
    weights: Tensor,
    episode: Episode,
    settings: PaperSettings,
) -> Belief:
    count = len(vectors)
    return Belief(
        prior=prior,
        vectors=vectors,
        weights=weights,
        misfit=MisfitField(sd=0.0),
        misfit_sd=torch.zeros(count, dtype=torch.float64),
        misfit_mean=torch.zeros(count, 0, dtype=torch.float64),
        misfit_covariance=torch.zeros(count, 0, 0, dtype=torch.float64),
        step=settings.step,
        stiffness=episode.stiffness.double(),
        log_evidence=math.nan,
        log_evidence_std=math.nan,
    )
