"""The cloud of particles that tempered sequential Monte Carlo moves, its budget and its record."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.likelihood import Threshold

LogDensity = Callable[[Tensor], Tensor]
"""Coordinates (m, d) to log density (m)."""


@runtime_checkable
class Target(Protocol):
    """A log posterior in unconstrained coordinates (m, d), its last datum new."""

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws (count, d) from the prior."""
        ...

    def log_prior(self, positions: Tensor) -> Tensor:
        """Log density (m) of the prior."""
        ...

    def log_likelihood(
        self, positions: Tensor, threshold: Threshold | None
    ) -> tuple[Tensor, Tensor]:
        """Log likelihood (m) of the history before and with the new datum; a particle that
        stays below its threshold may get -inf for both."""
        ...

    def curvature(
        self, positions: Tensor, spread: Tensor, temperature: float
    ) -> tuple[Tensor, Tensor]:
        """Gradient (m, d) and information (m, d, d), positive definite, of the log posterior
        with its new datum tempered. Only proposals depend on them, so they need not be exact;
        `spread` (d) is the standard deviation of the particles."""
        ...


@dataclass(frozen=True)
class SamplerSettings:
    """Budget and shape of the sampler."""

    particles: int = 700
    """Particles in the cloud once the history is long."""
    early_factor: float = 4.0
    """So many times more particles at the first datum, falling as 1 / k with datum k: while the
    history is short they are cheap, and the posterior is spread over many shapes."""
    kept_share: float = 0.5
    """Share of the effective sample size that one temperature step keeps."""
    components: int = 60
    """Components of the mixture that proposes."""
    tempering_moves: int = 2
    """Moves of every particle after each temperature but the last."""
    final_moves: int = 4
    """Moves at full likelihood once the datum is in."""
    modes: int = 40
    """Modes that are remembered from datum to datum."""
    fresh_modes: int = 40
    """Draws from the prior that climb to a mode at each datum."""
    climbing_rounds: int = 6
    """Newton steps of those."""
    following_rounds: int = 3
    """Newton steps of the modes that are remembered."""
    importance_rounds: int = 4
    """Rounds of importance sampling at each datum."""
    draws_per_component: int = 10
    """Draws from each component."""
    pool_share: float = 0.25
    """Share of all draws that a particle may exchange itself for."""
    independent_share: float = 0.5
    """Share of moves that are independent draws from the mixture; the rest are local steps."""

    def __post_init__(self) -> None:
        """Refuse budgets without meaning."""
        if self.particles < 16 or not 0 < self.kept_share < 1 or self.components < 1:
            raise ValueError(
                f"particles {self.particles} must be >= 16, kept_share {self.kept_share} in "
                f"(0, 1), components {self.components} >= 1"
            )
        if self.early_factor < 1:
            raise ValueError(f"early_factor is {self.early_factor}, expected at least 1")
        for name in (
            "tempering_moves",
            "final_moves",
            "climbing_rounds",
            "following_rounds",
        ):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 0")
        for name in ("modes", "fresh_modes", "importance_rounds", "draws_per_component"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")
        if not 0 < self.pool_share <= 1:
            raise ValueError(f"pool_share is {self.pool_share}, expected over 0 and at most 1")
        if not 0 <= self.independent_share <= 1:
            raise ValueError(f"independent_share is {self.independent_share}, expected 0 to 1")

    def at_most(self, count: int) -> int:
        """So many components or modes, but no more than a tenth of the particles."""
        return min(count, max(4, self.particles // 10))

    def particles_at(self, datum: int) -> int:
        """Particles in the cloud when datum 1, 2, ... is brought in."""
        return round(self.particles * max(1.0, self.early_factor / datum))


@dataclass(frozen=True)
class Cloud:
    """Equally weighted particles in unconstrained coordinates."""

    positions: Float[Tensor, "m d"]
    log_prior: Float[Tensor, " m"]
    log_likelihood: Float[Tensor, " m"]
    ancestor: Int[Tensor, " m"]
    """Particle before the last datum that each one descends from, or draw of importance
    sampling (numbered after them)."""
    log_evidence: float
    log_evidence_std: float
    """Standard error of the log evidence."""
    modes: Float[Tensor, "k d"]
    """Modes found so far; none before the first datum."""
    step_scale: float
    """Scale of the local moves, adapted to an acceptance near 1/4."""


@dataclass(frozen=True)
class CloudInfo:
    """What one update of the cloud cost and how well it mixed."""

    temperatures: int
    moves: int
    acceptance_independent: float
    acceptance_local: float
    effective_sample_size: float
    """Smallest effective sample size met at a temperature."""
    distinct_ancestors: int
    """Particles before the datum, and draws, that the particles descend from."""
    evaluations: int
    """Likelihood evaluations of one particle on the whole history, without derivatives."""


def start_cloud(positions: Float[Tensor, "m d"], log_prior: LogDensity) -> Cloud:
    """A cloud of draws from the prior, before any datum."""
    count, d = positions.shape
    return Cloud(
        positions=positions,
        log_prior=log_prior(positions),
        log_likelihood=torch.zeros(count, dtype=positions.dtype),
        ancestor=torch.arange(count),
        log_evidence=0.0,
        log_evidence_std=0.0,
        modes=positions[:0],
        step_scale=2.38 / math.sqrt(d),
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
