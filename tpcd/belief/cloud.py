"""The weighted particles that stand for a posterior, what they are drawn for, and their record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.proposals import DAMPINGS

CURVATURE_COST = 3
"""Evaluations that gradient and information cost together."""


@runtime_checkable
class Coordinates(Protocol):
    """Other coordinates of a posterior, in which it is less bent than in its scores."""

    @property
    def entries(self) -> Sequence[int]:
        """Which of them are nearly standard normal, whatever the others are; the others are
        scores."""
        ...

    def log_marginal(self, flat: Tensor, /) -> Tensor:
        """About the log likelihood (m) of the others, but for a constant."""
        ...

    def likeliest(self, flat: Tensor, /) -> tuple[Tensor, Tensor]:
        """Scores (m, d) of the others with about the likeliest entries that the prior allows, and
        about their log likelihood (m), but for a constant; -inf where there is none."""
        ...

    def to_score(self, flat: Tensor, /) -> tuple[Tensor, Tensor]:
        """Scores (m, d), and log |d score / d flat| (m); infinite scores have no prior density."""
        ...

    def from_score(self, score: Tensor, /) -> tuple[Tensor, Tensor]:
        """The inverse, and log |d score / d flat| (m) again."""
        ...


@runtime_checkable
class Target(Protocol):
    """A log posterior in unconstrained coordinates (m, d) of prior standard deviation 1."""

    def rough(self) -> Target:
        """About the same, and cheaper: good enough to find where the posterior is."""
        ...

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws (count, d) from the prior."""
        ...

    def scatter(self, count: int, generator: torch.Generator) -> Tensor:
        """Points (count, d) from all over the prior to look for modes from."""
        ...

    def log_prior(self, positions: Tensor, /) -> Tensor:
        """Log density (m) of the prior, normalised."""
        ...

    def log_likelihood(self, positions: Tensor, least: Tensor | None, /) -> Tensor:
        """Log likelihood (m) of the history; a particle that stays below its `least` (m) may
        get -inf."""
        ...

    def curvature(self, positions: Tensor, /) -> tuple[Tensor, Tensor]:
        """Gradient (m, d) and information (m, d, d), positive semi-definite, of the log
        posterior. Only proposals depend on them, so they need not be exact."""
        ...

    def log_likelihood_and_contact(self, positions: Tensor, /) -> tuple[Tensor, Tensor]:
        """Log likelihood (m) of the history, and what `coordinates` asks about contact (m, ...)."""
        ...

    def coordinates(self, positions: Tensor, weights: Tensor, contact: Tensor, /) -> Coordinates:
        """Coordinates that suit a posterior which positions (m, d) and weights (m) stand for."""
        ...


@dataclass
class Counted:
    """A target that counts the evaluations that it is asked for."""

    target: Target
    evaluations: int = 0

    def rough(self) -> Counted:
        """Of the target, which counts on from here."""
        return Counted(self.target.rough(), self.evaluations)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Of the target."""
        return self.target.sample(count, generator)

    def scatter(self, count: int, generator: torch.Generator) -> Tensor:
        """Of the target."""
        return self.target.scatter(count, generator)

    def log_prior(self, positions: Tensor) -> Tensor:
        """Of the target."""
        return self.target.log_prior(positions)

    def log_likelihood(self, positions: Tensor, least: Tensor | None) -> Tensor:
        """Of the target."""
        self.evaluations += len(positions)
        return self.target.log_likelihood(positions, least)

    def curvature(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Of the target."""
        self.evaluations += CURVATURE_COST * len(positions)
        return self.target.curvature(positions)

    def log_likelihood_and_contact(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Of the target."""
        self.evaluations += len(positions)
        return self.target.log_likelihood_and_contact(positions)

    def coordinates(self, positions: Tensor, weights: Tensor, contact: Tensor) -> Coordinates:
        """Of the target."""
        return self.target.coordinates(positions, weights, contact)


@dataclass(frozen=True)
class Cloud:
    """Weighted particles in unconstrained coordinates."""

    positions: Float[Tensor, "m d"]
    weights: Float[Tensor, " m"]
    """Weights that sum to 1."""
    log_likelihood: Float[Tensor, " m"]
    log_evidence: float
    log_evidence_std: float
    """Standard error of the log evidence."""
    modes: Float[Tensor, "k d"]
    """Modes found so far; none before the first datum."""
    shares: Float[Tensor, " t"]
    """Shares of the draws that go to each damping of the components."""


@dataclass(frozen=True)
class CloudInfo:
    """What one update of the cloud cost and how good the draws were."""

    rounds: int
    """Rounds that shaped the mixture; with the paper's filter whether it resampled (0 or 1)."""
    draws: int
    """Draws that were weighted."""
    effective_sample_size: float
    """Of all draws, before the largest weights are truncated; of the paper's particles."""
    tail_shape: float
    """Shape k of the distribution of the largest weights: over 0.7 they are not to be trusted
    (NaN with the paper's filter)."""
    distinct: int
    """Different draws among the particles; with the paper's filter ancestors they have."""
    evaluations: int
    """Evaluations of the likelihood of one particle on the whole history; its derivatives
    count as three."""


def start_cloud(positions: Float[Tensor, "m d"]) -> Cloud:
    """Draws from the prior, before any datum."""
    count = len(positions)
    return Cloud(
        positions=positions,
        weights=torch.full((count,), 1.0 / count, dtype=positions.dtype),
        log_likelihood=torch.zeros(count, dtype=positions.dtype),
        log_evidence=0.0,
        log_evidence_std=0.0,
        modes=positions[:0],
        shares=positions.new_full((len(DAMPINGS),), 1.0 / len(DAMPINGS)),
    )


def cloud_to_tensors(cloud: Cloud) -> dict[str, Tensor]:
    """The fields of a cloud as tensors, to be stored."""
    return {
        name: value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
        for name, value in vars(cloud).items()
    }


def cloud_from_tensors(tensors: dict[str, Tensor]) -> Cloud:
    """The cloud that `cloud_to_tensors` made tensors of."""
    fields = {n: float(v) if v.ndim == 0 else v for n, v in tensors.items()}
    return Cloud(**fields)  # type: ignore[arg-type]
