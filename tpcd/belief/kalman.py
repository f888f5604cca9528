"""Extended Kalman filter over the transitions, for given theta and batches of particles.

The unknowns that theta leaves are linear and normal: the coefficients c of the misfit field,
and the error e_k of each estimated pose, poses[k] = true pose + e_k with e_k ~ N(0, R_k). A
transition starts at the filtered pose s = poses[k - 1] - E[e_{k-1}], with terrains as far away
as the filtered field g = E[c] says, and leaves the residual

    r_k = poses[k] - f(s, g, u_k) + H_k g = e_k - F_k (e_{k-1} - E[e_{k-1}]) + H_k c + v_k,

with F = d pose / d start, H from `misfit_rows` and v_k ~ N(0, V_k) what each reading's outline
has besides. So one reading's error is in two residuals, and the state (c, e_{k-1}) is carried
from one transition to the next. In free motion the arm reaches its command, and what was read
there no longer matters. The innovations give the likelihood of theta term by term, and the
state the posterior of the field (Kalman 1960; Rao-Blackwellised particle filters).

Contact is anything but linear where the field is unknown by millimetres: a terrain taken to be
there may not be touched where it is. So a transition that moves a gap far is stepped again with
the terrain where the state after it says, and brought in from there (Bell and Cathey 1993: the
iterated filter is Gauss and Newton's method), unless it is not explained from there. A terrain
that theta and the field leave untouched has no derivative to say that it is nearer: where the
object was held back before it, and this is not explained, the transition is stepped again with
that terrain just touched at the pose that was read, if this is likelier.

A transition far outside of what theta and the field allow (an object wedged between floor
and wall, a bad reading) has its innovation covariance grown until the innovation lies at the
border: its log likelihood then falls with the logarithm of the distance, as for a Student
distribution, and it no longer bends the state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

OUTLIER_SQUARE = 16.3
"""Squared Mahalanobis distance (3 degrees of freedom, 0.1 %) from which a transition counts
as not explained: its covariance grows so that it stays at this distance."""

PASSES = 3
"""Times at most that a transition is stepped and brought in: the third is the first again, where
the second explains less."""
FAR = 3e-4
"""Change of a gap [m] by which a transition is stepped again: about its reading's noise."""


@dataclass(frozen=True)
class FieldState:
    """Normal belief over s = c + 3 numbers, the misfit coefficients and the error of the last
    pose, m particles."""

    mean: Float[Tensor, "m s"]
    covariance: Float[Tensor, "m s s"]


@dataclass(frozen=True)
class Innovation:
    """What a transition brings that was not known before, in independent standard units."""

    whitened: Float[Tensor, "m 3"]
    log_scale: Float[Tensor, "m 3"]
    """Logarithm of the units [log m, log m, log rad]."""

    @property
    def explained(self) -> Bool[Tensor, " m"]:
        """Whether it lies within `OUTLIER_SQUARE`."""
        return (self.whitened**2).sum(-1) < OUTLIER_SQUARE * (1 - 1e-9)

    @property
    def log_density(self) -> Float[Tensor, " m"]:
        """Log density of the transition's residual given those before."""
        each = 0.5 * self.whitened**2 + self.log_scale + 0.5 * math.log(2 * math.pi)
        return -each.sum(-1)


def first_state(
    sd: Float[Tensor, " m"], coefficients: int, variance: Float[Tensor, "*each 3"]
) -> FieldState:
    """Before any transition: coefficients of standard deviation sd, first pose of `variance`."""
    field = (sd**2)[:, None].expand(-1, coefficients)
    diagonal = torch.cat((field, variance.expand(len(sd), 3)), dim=-1)
    return FieldState(torch.zeros_like(diagonal), torch.diag_embed(diagonal))


def parted(state: FieldState, count: int, variance: Float[Tensor, "*each 3"]) -> FieldState:
    """The state past a transition that does not count: of the pose only its reading is known."""
    mean, covariance = state.mean.clone(), torch.zeros_like(state.covariance)
    mean[:, count:] = 0.0
    covariance[:, :count, :count] = state.covariance[:, :count, :count]
    covariance[:, count:, count:] = torch.diag_embed(variance)
    return FieldState(mean, covariance)


def assimilate(
    state: FieldState,
    residual: Float[Tensor, "m 3"],
    rows: Float[Tensor, "m 3 c"],
    from_start: Float[Tensor, "m 3 3"],
    variance: Float[Tensor, "*each 3"],
    uncovered: Float[Tensor, "m 3 3"],
) -> tuple[FieldState, Innovation]:
    """The state after a transition that started at the filtered pose, and its innovation."""
    count = rows.shape[-1]
    design = torch.cat((rows, -from_start), dim=-1)
    cross = state.covariance @ design.mT
    noise = torch.diag_embed(variance)
    covariance = design @ cross + noise + uncovered
    innovation = residual - (rows @ state.mean[:, :count, None])[..., 0]
    factor, whitened = _whiten(covariance, innovation)
    square = (whitened**2).sum(-1)
    growth = (square / OUTLIER_SQUARE).clamp_min(1.0)
    # Growing the covariance by a number stretches its factor by the root.
    factor, whitened = factor * growth.sqrt()[:, None, None], whitened / growth.sqrt()[:, None]
    found = Innovation(whitened, factor.diagonal(dim1=-2, dim2=-1).log())
    # The next state: the field goes on, the error of this pose takes the place of the last.
    answer = torch.cat((cross[:, :count], noise.expand_as(covariance)), dim=1)
    gain = torch.linalg.solve_triangular(factor, answer.mT, upper=False).mT
    keep = torch.cat((state.mean[:, :count], torch.zeros_like(innovation)), dim=-1)
    before = torch.zeros_like(state.covariance)
    before[:, :count, :count] = state.covariance[:, :count, :count]
    before[:, count:, count:] = noise
    mean = keep + (gain @ whitened[..., None])[..., 0]
    return FieldState(mean, before - gain @ gain.mT), found


def _whiten(covariance: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factor L of each covariance, and L^-1 vector."""
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(factor, vector[..., None], upper=False)
    return factor, whitened[..., 0]
