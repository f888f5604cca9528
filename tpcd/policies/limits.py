"""What a command may ask of the arm: step, workspace, and force."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.prediction import Prediction


@dataclass(frozen=True)
class Limits:
    """Bounds on the next command; the defaults suit a stiffness of about 100 N/m."""

    force: float = 8.0
    """Largest force on an axis, |F_x| or |F_z| [N]."""
    step: tuple[float, float, float] = (0.08, 0.08, 0.3)
    """Farthest a command may be from the measured pose, on each axis [m, m, rad]."""
    low: tuple[float, float, float] = (-math.inf, -math.inf, -0.15)
    """Lower corner of the workspace of commands [m, m, rad]."""
    high: tuple[float, float, float] = (math.inf, math.inf, 0.15)
    """Upper corner of the workspace [m, m, rad]."""
    probability: float = 0.05
    """A command that exceeds the force limit with more than this probability is not taken."""

    def __post_init__(self) -> None:
        """Refuse limits without meaning."""
        if not self.force > 0 or not all(0 < step < math.inf for step in self.step):
            raise ValueError(f"force limit {self.force} and step {self.step} must be positive")
        if not len(self.step) == len(self.low) == len(self.high) == 3:
            lengths = f"{len(self.step)}, {len(self.low)} and {len(self.high)} numbers"
            raise ValueError(f"step, low and high have {lengths}, expected 3 (x, z, phi)")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"workspace from {self.low} to {self.high}, expected low < high")
        if not 0 < self.probability < 1:
            raise ValueError(f"probability is {self.probability}, expected it between 0 and 1")

    def box(
        self, pose: Float[Tensor, " 3"], stiffness: Float[Tensor, " 3"], strides: float = 1.0
    ) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """Lowest and highest command from a pose: within the workspace, and no farther than a
        step and than what an arm that were blocked on the spot would bear; or than so many of
        both (`strides`). From outside of the workspace, the way back is made in such steps."""
        step = torch.tensor(self.step, dtype=torch.float64)
        step[:2] = torch.minimum(step[:2], self.force / stiffness[:2].double())
        nearest, farthest = pose.double() - strides * step, pose.double() + strides * step
        low, high = (torch.tensor(v, dtype=torch.float64) for v in (self.low, self.high))
        clamp = [torch.minimum(torch.maximum(v, nearest), farthest) for v in (low, high)]
        return clamp[0], clamp[1]

    def excess_probability(self, prediction: Prediction) -> Float[Tensor, " n"]:
        """Probability that each predicted transition ends with more than the force limit, at
        most (the sum over axes); 1 where the belief has no answer."""
        mean, variance = (value[..., 3:5] for value in prediction.true_moments())
        std = variance.sqrt()
        outside = torch.special.ndtr((mean - self.force) / std)
        outside = outside + torch.special.ndtr((-mean - self.force) / std)
        weights = prediction.weights.nan_to_num(0.0)
        excess = (weights * outside.sum(-1)).sum(0).clamp(0.0, 1.0)
        return torch.where(prediction.answered, excess, 1.0)
