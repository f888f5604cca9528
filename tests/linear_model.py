"""A linear-normal model with known posterior and evidence, and targets made of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

DIMENSION = 3
NOISE = 0.3
Likelihood = Callable[[Tensor], Tensor]


class LinearModel:
    """y_k = a_k . x + noise with x ~ N(0, I): everything about it is known."""

    def __init__(self, count: int, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.rows = torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)
        truth = torch.randn(DIMENSION, generator=generator, dtype=torch.float64)
        noise = torch.randn(count, generator=generator, dtype=torch.float64)
        self.data = self.rows @ truth + NOISE * noise

    def target(self, count: int, likelihood: Likelihood | None = None) -> LinearTarget:
        """The posterior of the first data, or of another likelihood."""

        def known(x: Tensor) -> Tensor:
            error = (self.data[:count] - x @ self.rows[:count].T) / NOISE
            each = -0.5 * error**2 - math.log(NOISE) - 0.5 * math.log(2 * math.pi)
            return each.sum(-1)

        return LinearTarget(self, count, likelihood or known)

    def posterior(self, count: int) -> tuple[Tensor, Tensor, float]:
        """Mean, covariance and log evidence."""
        rows, data = self.rows[:count], self.data[:count]
        precision = torch.eye(DIMENSION, dtype=torch.float64) + rows.T @ rows / NOISE**2
        covariance = torch.linalg.inv(precision)
        marginal = rows @ rows.T + NOISE**2 * torch.eye(count, dtype=torch.float64)
        half = torch.linalg.solve_triangular(
            torch.linalg.cholesky(marginal), data[:, None], upper=False
        )
        scale = torch.linalg.slogdet(2 * math.pi * marginal)[1]
        log_evidence = float(-0.5 * (half.square().sum() + scale))
        return covariance @ rows.T @ data / NOISE**2, covariance, log_evidence


@dataclass(frozen=True)
class LinearTarget:
    """The first data of a model, or another likelihood in their place."""

    model: LinearModel
    count: int
    likelihood: Likelihood
    roughly: Likelihood | None = None
    """Likelihood of what is rough, where it is another one."""

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.randn(count, DIMENSION, generator=generator, dtype=torch.float64)

    def rough(self) -> LinearTarget:
        return replace(self, likelihood=self.roughly or self.likelihood)

    def scatter(self, count: int, generator: torch.Generator) -> Tensor:
        return self.sample(count, generator)

    def log_prior(self, x: Tensor) -> Tensor:
        return -0.5 * (x**2).sum(-1) - 0.5 * DIMENSION * math.log(2 * math.pi)

    def log_likelihood(self, x: Tensor, least: Tensor | None) -> Tensor:
        value = self.likelihood(x)
        return value if least is None else torch.where(value < least, -torch.inf, value)

    def curvature(self, x: Tensor) -> tuple[Tensor, Tensor]:
        rows, data = self.model.rows[: self.count], self.model.data[: self.count]
        gradient = (data - x @ rows.T) @ rows / NOISE**2 - x
        information = torch.eye(DIMENSION).double() + rows.T @ rows / NOISE**2
        return gradient, information.expand(len(x), -1, -1)

    def log_likelihood_and_contact(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.log_likelihood(x, None), x[:, :0]

    def coordinates(self, x: Tensor, weights: Tensor, contact: Tensor) -> Sheared:
        information = self.curvature(x[:1])[1][0]
        centre = self.model.posterior(self.count)[0]
        return Sheared(centre, information)


@dataclass(frozen=True)
class Sheared:
    """The first entry in deviations from what the others say it is."""

    centre: Tensor
    information: Tensor

    @property
    def entries(self) -> list[int]:
        return [0]

    def _given(self, x: Tensor) -> tuple[Tensor, Tensor]:
        along = self.information[0, 1:] / self.information[0, 0]
        mean = self.centre[0] - (x[:, 1:] - self.centre[1:]) @ along
        return mean, self.information[0, 0].rsqrt()

    def to_score(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        mean, std = self._given(flat)
        score = torch.cat(((mean + std * flat[:, 0])[:, None], flat[:, 1:]), dim=-1)
        return score, std.log().expand(len(flat))

    def from_score(self, score: Tensor) -> tuple[Tensor, Tensor]:
        mean, std = self._given(score)
        flat = torch.cat((((score[:, 0] - mean) / std)[:, None], score[:, 1:]), dim=-1)
        return flat, std.log().expand(len(flat))

    def log_marginal(self, flat: Tensor) -> Tensor:
        return torch.zeros_like(flat[:, 0])

    def likeliest(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        best = torch.cat((torch.zeros_like(flat[:, :1]), flat[:, 1:]), dim=-1)
        return self.to_score(best)[0], self.log_marginal(flat)


class Unchanged:
    """Coordinates that are the scores themselves."""

    entries: tuple[int, ...] = ()

    def to_score(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        return flat, torch.zeros_like(flat[:, 0])

    from_score = to_score

    def log_marginal(self, flat: Tensor) -> Tensor:
        return torch.zeros_like(flat[:, 0])

    def likeliest(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        return flat, self.log_marginal(flat)
