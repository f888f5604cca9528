"""Likelihood of a history given theta: every datum once, noise propagated, misfit integrated.

For transition k the model starts at a *measured* pose, so with F = d pose / d start the
settled pose is normal with covariance S_k = R_k + F_k R_start F_k^T. The misfit field adds
H_k c with c ~ N(0, sd^2 I). Given theta all of it is linear and normal, and with
A = I / sd^2 + sum_k H_k^T S_k^-1 H_k and v = sum_k H_k^T S_k^-1 r_k

    log p(data | theta) = sum_k log N(r_k; 0, S_k) + 1/2 v^T A^-1 v - 1/2 log |sd^2 A|,

while c given the data is N(A^-1 v, A^-1). A transition far outside of what theta and the
field allow (an object wedged between floor and wall, a bad reading) has its S_k grown until
S_k + sd^2 H_k H_k^T puts it just at the border: its log likelihood then falls with the
logarithm of the distance, as for a Student distribution, and it no longer bends the belief.
A particle whose step does not converge or is not finite gets log likelihood -inf.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField, misfit_rows
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, Transition, native, simulate_step
from tpcd.terrain import HalfPlane

OUTLIER_SQUARE = 16.3
"""Squared Mahalanobis distance (3 degrees of freedom, 0.1 %) from which a transition counts
as not explained: its covariance grows so that it stays at this distance."""


@dataclass(frozen=True)
class HistoryLikelihood:
    """What theta says about a history, m particles.

    `total` is the log likelihood of all transitions and `before` of all but the last;
    `field_mean` and `field_precision` the normal posterior of the misfit coefficients.
    """

    total: Float[Tensor, " m"]
    before: Float[Tensor, " m"]
    field_mean: Float[Tensor, "m c"]
    field_precision: Float[Tensor, "m c c"]


def history_likelihood(
    shape: Shape,
    parameters: Parameters,
    history: History,
    field: MisfitField,
    settings: StepSettings,
) -> HistoryLikelihood:
    """Evaluate m particles on the n transitions of a history."""
    scene = column_scene(scene_from_parameters(shape, parameters))
    transition = simulate_step(
        scene,
        history.start,
        history.command,
        history.stiffness,
        settings,
        previous=history.previous,
    )
    if native.available() and _detached(transition):
        return _compiled(history, field, transition)
    residual = history.settled - transition.pose
    residual = torch.cat((residual[..., :2], wrap_angle(residual[..., 2:])), dim=-1)
    spread = transition.pose_from_start * history.start_variance[:, None, :].sqrt()
    covariance = spread @ spread.mT + torch.diag_embed(history.settled_variance)
    rows, uncovered = misfit_rows(field, history.settled[:, 2], transition)
    covariance = covariance + uncovered
    covariance = covariance + _outlier_covariance(field, covariance, residual, rows)
    columns = torch.cat((residual[..., None], rows), dim=-1)
    whitened, log_determinant = _whiten(covariance, columns)
    error, rows = whitened[..., 0], whitened[..., 1:]
    each = -0.5 * (error**2).sum(-1) - 0.5 * log_determinant - 1.5 * math.log(2 * math.pi)
    usable = (transition.status <= int(StepStatus.RELAXED)) & torch.isfinite(each)
    usable = usable & torch.isfinite(parameters.to_vector()).all(-1, keepdim=True)
    each = torch.where(usable, each, -torch.inf)
    total, mean, precision = _marginalise(field, each, error, rows)
    if len(history) > 1:
        before, _, _ = _marginalise(field, each[:, :-1], error[:, :-1], rows[:, :-1])
    else:
        before = torch.zeros_like(total)
    return HistoryLikelihood(total, before, mean, precision)


def _detached(transition: Transition) -> bool:
    """Whether the compiled loops may be used: on the CPU, and nobody asks for a gradient."""
    return transition.pose.device.type == "cpu" and not transition.pose.requires_grad


def _compiled(history: History, field: MisfitField, transition: Transition) -> HistoryLikelihood:
    from tpcd.belief.kernel import evaluate_range

    count = len(transition.pose)
    size = field.bumps * transition.pose_from_gap.shape[-2]
    values, slopes = field.basis(history.settled[:, 2])
    total, before = (torch.empty(count, dtype=torch.float64) for _ in range(2))
    mean = torch.empty(count, size, dtype=torch.float64)
    precision = torch.empty(count, size, size, dtype=torch.float64)
    arrays = (
        transition.pose.numpy(),
        transition.status.numpy(),
        transition.pose_from_start.numpy(),
        transition.pose_from_gap.numpy(),
        transition.pose_from_lever.numpy(),
        history.settled.contiguous().numpy(),
        history.settled_variance.contiguous().numpy(),
        history.start_variance.contiguous().numpy(),
        values.numpy(),
        slopes.numpy(),
    )
    scalars = (field.sd, OUTLIER_SQUARE, int(StepStatus.RELAXED))
    answers = (total.numpy(), before.numpy(), mean.numpy(), precision.numpy())
    native.in_parts(
        lambda first, last: evaluate_range(*arrays, *scalars, first, last, *answers), count
    )
    return HistoryLikelihood(total, before, mean, precision)


def _outlier_covariance(
    field: MisfitField, covariance: Tensor, residual: Tensor, rows: Tensor
) -> Tensor:
    """What is added to the covariance of transitions that theta does not explain, else 0.

    With M = covariance + sd^2 H H^T and q = r^T M^-1 r it is (q / limit - 1) M, so that M grows
    to M q / limit and the distance to the limit itself, whatever share of M is the field's.
    """
    marginal = covariance + field.sd**2 * (rows @ rows.mT)
    whitened, _ = _whiten(marginal, residual[..., None])
    square = whitened.square().sum((-2, -1))
    return ((square / OUTLIER_SQUARE).clamp_min(1.0) - 1.0)[..., None, None] * marginal


def column_scene(scene: ContactScene) -> ContactScene:
    """The scenes of m particles with an axis for the transitions: batch (m, 1)."""
    planes = []
    for body in scene.terrains:
        assert isinstance(body, HalfPlane)
        planes.append(HalfPlane(body.direction[..., None, :], body.offset[..., None]))
    return ContactScene(
        scene.points_ee[..., None, :, :], tuple(planes), scene.friction[..., None, :]
    )


def _marginalise(
    field: MisfitField, each: Tensor, error: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Integrate the field out of whitened residuals (m, n, 3) and rows (m, n, 3, c)."""
    total = each.sum(-1)
    count = rows.shape[-1]
    if count == 0:
        return total, error.new_zeros(len(error), 0), error.new_zeros(len(error), 0, 0)
    # Invalid particles carry NaN rows; they must not reach the factorisation.
    valid = torch.isfinite(total)
    flat = torch.where(valid[:, None, None], rows.flatten(1, 2), 0.0)
    errors = torch.where(valid[:, None], error.flatten(1, 2), 0.0)
    precision = flat.mT @ flat
    precision = precision + torch.eye(count, dtype=precision.dtype) / field.sd**2
    vector = (flat.mT @ errors[..., None])[..., 0]
    factor = torch.linalg.cholesky(precision)
    mean = torch.cholesky_solve(vector[..., None], factor)[..., 0]
    log_determinant = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    gain = 0.5 * (vector * mean).sum(-1) - 0.5 * log_determinant - count * math.log(field.sd)
    return torch.where(valid, total + gain, -torch.inf), mean, precision


def _whiten(covariance: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """L^-1 columns and log |covariance| for 3 x 3 covariances, in explicit form for speed."""
    a = covariance[..., 0, 0].sqrt()
    b = covariance[..., 1, 0] / a
    c = covariance[..., 2, 0] / a
    d = (covariance[..., 1, 1] - b**2).sqrt()
    e = (covariance[..., 2, 1] - b * c) / d
    f = (covariance[..., 2, 2] - c**2 - e**2).sqrt()
    first = columns[..., 0, :] / a[..., None]
    second = (columns[..., 1, :] - b[..., None] * first) / d[..., None]
    third = (columns[..., 2, :] - c[..., None] * first - e[..., None] * second) / f[..., None]
    log_determinant = 2 * (a.log() + d.log() + f.log())
    return torch.stack((first, second, third), dim=-2), log_determinant
