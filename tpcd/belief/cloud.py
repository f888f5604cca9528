"""The cloud of particles that tempered sequential Monte Carlo moves, its budget and its record."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.proposals import StudentMixture

LogDensity = Callable[[Tensor], Tensor]
"""Coordinates (m, d) to log density (m)."""

_MIXTURE = "mixture."


@dataclass(frozen=True)
class SamplerSettings:
    """Budget and shape of the sampler."""

    particles: int = 700
    """Particles in the cloud once the history is long."""
    early_factor: float = 16.0
    """So many times more particles at the first datum, falling as 1 / k with datum k: while the
    history is short they are cheap, and the posterior is spread over many shapes."""
    kept_share: float = 0.5
    """Share of the effective sample size that one temperature step keeps."""
    components: int = 8
    """Components of the fitted mixture."""
    tempering_moves: int = 5
    """Moves of every particle after each temperature but the last."""
    final_moves: int = 8
    """Moves at full likelihood once the datum is in."""
    moves_per_fit: int = 4
    """The mixture is fitted again to the moved particles after so many moves."""
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
        if min(self.tempering_moves, self.final_moves) < 0 or self.moves_per_fit < 1:
            raise ValueError(
                f"tempering_moves {self.tempering_moves} and final_moves {self.final_moves} "
                f"must be >= 0, moves_per_fit {self.moves_per_fit} >= 1"
            )
        if not 0 <= self.independent_share <= 1:
            raise ValueError(f"independent_share is {self.independent_share}, expected 0 to 1")

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
    """Particle of the first cloud that each one descends from."""
    log_evidence: float
    log_evidence_std: float
    """Standard error of the log evidence."""
    step_scale: float
    """Scale of the local moves, adapted to an acceptance near 1/4."""
    mixture: StudentMixture | None = None
    """The mixture last fitted to the particles, from which the next fit starts."""


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
    evaluations: int
    """Likelihood evaluations of one particle on the whole history."""


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
        step_scale=2.38 / math.sqrt(d),
    )


def cloud_to_tensors(cloud: Cloud) -> dict[str, Tensor]:
    """The fields of a cloud as tensors, to be stored."""
    fields = {name: value for name, value in vars(cloud).items() if name != "mixture"}
    if cloud.mixture is not None:
        fields |= {_MIXTURE + name: value for name, value in vars(cloud.mixture).items()}
    return {
        name: value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
        for name, value in fields.items()
    }


def cloud_from_tensors(tensors: dict[str, Tensor]) -> Cloud:
    """The cloud that `cloud_to_tensors` made tensors of."""
    fields = {n: float(v) if v.ndim == 0 else v for n, v in tensors.items()}
    mixture = {n: fields.pop(n) for n in tuple(fields) if n.startswith(_MIXTURE)}
    parts = {name.removeprefix(_MIXTURE): value for name, value in mixture.items()}
    return Cloud(**fields, mixture=StudentMixture(**parts) if parts else None)  # type: ignore[arg-type]
