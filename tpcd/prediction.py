"""A prediction of settled poses and wrenches: a mixture of normals over the particles of a belief.

The wrench follows from the pose, so one mixture serves both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.planar import wrap_angle
from tpcd.simulator.record import StepStatus

CHANNELS = ("x", "z", "phi", "F_x", "F_z", "tau")
"""The predicted channels in order; units m, m, rad, N, N, N·m."""
_BISECTIONS = 26


@dataclass(frozen=True)
class Prediction:
    """A mixture of normals for each of n transitions, over m particles.

    `component_mean` and `component_std` are those of the settled pose given the particle;
    channel order and units as in `CHANNELS`.
    """

    command: Float[Tensor, "n 3"]
    stiffness: Float[Tensor, " 3"]
    weights: Float[Tensor, "m n"]
    """Weights of the particles for each transition; 0 for a particle that gave no answer."""
    component_mean: Float[Tensor, "m n 3"]
    component_covariance: Float[Tensor, "m n 3 3"]
    component_mode: Int[Tensor, "m n t"]
    answered: Bool[Tensor, " n"]
    """Whether any particle gave an answer; where not, everything else is NaN."""
    sensor_variance: Float[Tensor, " 6"]
    """Variance of the sensor noise that is part of the prediction."""
    component_wrench: Float[Tensor, "m n 3"] | None = None
    """Wrench given the particle; None where it is K (x' - u)."""
    wrench_matrix: Float[Tensor, "m n 3 3"] | None = None
    """How that wrench answers the settled pose; None where by K."""
    component_field: Float[Tensor, "m n 3 j"] | None = None
    """Factor L of the part L L^T of `component_covariance` that comes from what is not known yet of
    the outline's misfit, in j standard normal numbers of the particle; None where not asked for."""

    component_status: Int[Tensor, "m n"] | None = None
    """`StepStatus` of each particle's answer; None where it is not known."""

    @property
    def start_inside(self) -> Float[Tensor, " n"]:
        """Probability that the start pose is inside a terrain, by more than a measurement errs.

        Where it is near 1, the pose is of another frame, unit or scene than the belief.
        """
        if self.component_status is None:
            return torch.full_like(self.weights[0], torch.nan)
        inside = self.component_status == int(StepStatus.START_INSIDE)
        return (self.weights * inside).sum(0)

    @property
    def component_variance(self) -> Float[Tensor, "m n 3"]:
        """Variances of the settled pose given the particle."""
        return self.component_covariance.diagonal(dim1=-2, dim2=-1)

    @property
    def mean(self) -> Float[Tensor, "n 6"]:
        """Mean of pose and wrench."""
        mean, _ = self._components()
        return (self.weights[..., None] * mean).sum(0)

    @property
    def std(self) -> Float[Tensor, "n 6"]:
        """Standard deviation of pose and wrench."""
        mean, std = self._components()
        square = std**2 + (mean - self.mean) ** 2
        return (self.weights[..., None] * square).sum(0).sqrt()

    @property
    def mode_probability(self) -> Float[Tensor, "n t 4"]:
        """Probability of each `ContactMode` against each terrain."""
        one_hot = torch.nn.functional.one_hot(self.component_mode, 4).to(self.weights.dtype)
        return (self.weights[..., None, None] * one_hot).sum(0)

    def quantile(self, level: float) -> Float[Tensor, "n 6"]:
        """The level at which each channel's distribution function is reached.

        Raises ValueError for a level outside of (0, 1).
        """
        if not 0 < level < 1:
            raise ValueError(f"level is {level}, expected a number between 0 and 1")
        mean, std = self._components()
        weights = self.weights[..., None]
        low = (mean - 12 * std).amin(0)
        high = (mean + 12 * std).amax(0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below = (weights * torch.special.ndtr((middle - mean) / std)).sum(0) < level
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        middle = 0.5 * (low + high)
        return torch.where(self.answered[:, None], middle, torch.nan)

    def probability_below(self, value: Float[Tensor, "n 6"]) -> Float[Tensor, "n 6"]:
        """Each channel's distribution function at a value: the probability integral transform."""
        mean, std = self._components()
        offset = value - mean
        turn = wrap_angle(offset[..., 2:3])
        offset = torch.cat((offset[..., :2], turn, offset[..., 3:]), dim=-1)
        return (self.weights[..., None] * torch.special.ndtr(offset / std)).sum(0)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count n 6"]:
        """Joint draws of pose and wrench for each transition."""
        weights = torch.where(self.answered, self.weights, 1.0 / len(self.weights))
        chosen = torch.multinomial(weights.T, count, replacement=True, generator=generator).T
        columns = torch.arange(chosen.shape[1])
        mean = self._components()[0][chosen, columns]
        factor = torch.linalg.cholesky(self.component_covariance[chosen, columns])
        noise = torch.randn(*mean.shape[:-1], 3, generator=generator, dtype=mean.dtype)
        moved = factor @ noise[..., None]
        matrix = self._matrix().expand(*self.weights.shape, 3, 3)[chosen, columns]
        draws = mean + torch.cat((moved, matrix @ moved), dim=-2)[..., 0]
        sensor = torch.randn(draws.shape, generator=generator, dtype=mean.dtype)
        draws = draws + sensor * self.sensor_variance.sqrt()
        return torch.where(self.answered[:, None], draws, torch.nan)

    def true_moments(self) -> tuple[Float[Tensor, "m n 6"], Float[Tensor, "m n 6"]]:
        """Mean and variance of pose and wrench given the particle, without what sensors add."""
        wrench = self.component_wrench
        if wrench is None:
            offset = self.component_mean - self.command
            offset = torch.cat((offset[..., :2], wrap_angle(offset[..., 2:])), dim=-1)
            wrench = self.stiffness * offset
        matrix, covariance = self._matrix(), self.component_covariance
        spread = ((matrix @ covariance) * matrix).sum(-1)
        variance = torch.cat((self.component_variance, spread), dim=-1)
        mean = torch.cat((self.component_mean, wrench), dim=-1)
        return mean, variance

    def _components(self) -> tuple[Tensor, Tensor]:
        mean, variance = self.true_moments()
        return mean, (variance + self.sensor_variance).sqrt()

    def _matrix(self) -> Tensor:
        return torch.diag(self.stiffness) if self.wrench_matrix is None else self.wrench_matrix
