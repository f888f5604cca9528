"""Commands by the paper's Algorithm 2: a grid around a basic trajectory, ranked by its gain.

27 commands, the basic trajectory's next one and its neighbours on a uniform grid of ±0.03 m,
±0.03 m and ±0.025 rad, are weighed with M / 5 particles, one step ahead (Kim, Zhu and Dollar,
arXiv 2409.17470, Algorithm 2). The gain of an outcome is the Kullback-Leibler divergence of
the weights after it from those before, under the filter's likelihood exp(-1/2 e^T R^-1 e).

One departure: the expected gain is the average over outcomes by the belief's weights. The
text averages them evenly, whatever the belief thinks of the particle that brought them.
Outcomes are what particles predict, without noise, as there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.prediction import Prediction

_ROWS_AT_ONCE = 256
"""Outcomes compared with all particles at once: as many as stay in the cache."""


@dataclass(frozen=True)
class GridSettings:
    """The paper's numbers."""

    reach: tuple[float, float, float] = (0.03, 0.03, 0.025)
    """Half width of the grid [m, m, rad]."""
    covariance: tuple[float, ...] = (30.0, 30.0, 0.3, 1e-4, 1e-4, 0.002)
    """Diagonal of R for F_x, F_z [N^2], tau [N^2 m^2], x, z [m^2], phi [rad^2]."""
    share: float = 0.2
    """Share of the filter's particles that take part."""


def grid_commands(
    basic: Float[Tensor, " 3"], settings: GridSettings | None = None
) -> Float[Tensor, "27 3"]:
    """The 27 commands around the basic trajectory's next one, that one included."""
    reach = torch.tensor((settings or GridSettings()).reach, dtype=torch.float64)
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    return basic + reach * torch.cartesian_prod(steps, steps, steps)


def grid_gain(prediction: Prediction, settings: GridSettings | None = None) -> Float[Tensor, " c"]:
    """Expected gain [nat] of each command, from what the particles predict for it.

    A command that no particle can answer has the gain 0.
    """
    settings = settings or GridSettings()
    pose = prediction.component_mean
    wrench = prediction.stiffness * (pose - prediction.command)
    scale = torch.tensor(settings.covariance, dtype=pose.dtype).sqrt()
    rows = torch.cat((wrench, pose), dim=-1) / scale
    weights = prediction.weights.nan_to_num(0.0)
    gains = [_gain(rows[:, c], weights[:, c]) for c in range(rows.shape[1])]
    return torch.stack(gains)


def _gain(rows: Tensor, weights: Tensor) -> Tensor:
    """Gain of one command: `rows` (m, 6) are predictions in units of the noise.

    The log likelihood of an outcome is largest, zero, under the particle it comes from, so
    that sums of its exponentials neither overflow nor vanish.
    """
    kept = weights > 0
    centred = (rows[kept] - weights[kept] @ rows[kept]).float()
    weights = weights[kept].float()
    half = 0.5 * centred.square().sum(-1)
    total = torch.zeros((), dtype=torch.float64)
    for part, own, share in zip(
        centred.split(_ROWS_AT_ONCE), half.split(_ROWS_AT_ONCE), weights.split(_ROWS_AT_ONCE),
        strict=True,
    ):  # fmt: skip
        log_likelihood = torch.addmm(-half, part, centred.T).sub_(own[:, None]).clamp_max_(0.0)
        likelihood = log_likelihood.exp()
        norm = likelihood @ weights
        mean_log = likelihood.mul_(log_likelihood) @ weights / norm
        total += (share * (mean_log - norm.log())).sum().double()
    return total.clamp_min(0.0)
