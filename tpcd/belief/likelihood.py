"""Likelihood of a history given theta: every datum once, noise propagated, misfit integrated.

Each particle steps every transition from its filtered start pose and filters the residual as
`kalman` says, which integrates the misfit field and the reading errors out. A particle whose
step does not converge or is not finite gets log likelihood -inf.

A sampler that has drawn its random number already knows what log likelihood a proposal must
reach. No term can exceed the density of its reading's own noise at zero, log N(0; 0, R_k), so
that a proposal may be given up once even that would not lift it over its threshold (`least`).
This changes no decision; it spares most of the cost of bad proposals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.kalman import OUTLIER_SQUARE, Innovation, assimilate, first_state
from tpcd.belief.misfit import MisfitField, misfit_rows
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, native, simulate_step
from tpcd.simulator.step import needs_gradient

if TYPE_CHECKING:
    from tpcd.simulator.kernel_slopes import SceneSlopes


@dataclass(frozen=True)
class HistoryLikelihood:
    """What theta says about a history, m particles.

    `total` is the log likelihood, -inf for a particle that was given up; `field_mean` and
    `field_covariance` are the normal posterior of the misfit coefficients. Where they are asked
    for, `whitened` and `log_scale` are the innovations of the n transitions (see
    `kalman.Innovation`), NaN without one, and `slopes` the derivatives of `whitened` by d
    coordinates.
    """

    total: Float[Tensor, " m"]
    field_mean: Float[Tensor, "m c"]
    field_covariance: Float[Tensor, "m c c"]
    whitened: Float[Tensor, "m n 3"] | None = None
    log_scale: Float[Tensor, "m n 3"] | None = None
    slopes: Float[Tensor, "m d n 3"] | None = None


def history_likelihood(
    shape: Shape,
    parameters: Parameters,
    misfit_sd: Float[Tensor, " m"],
    history: History,
    field: MisfitField,
    settings: StepSettings,
    least: Float[Tensor, " m"] | None = None,
    innovations: bool = False,
) -> HistoryLikelihood:
    """Evaluate m particles, each with its own size of the outline misfit, on n transitions."""
    if least is not None and not innovations:
        hopeless = least == torch.inf
        if bool(hopeless.any()):
            return _without(hopeless, shape, parameters, misfit_sd, history, field, settings, least)
    inputs = (parameters.to_vector(), misfit_sd)
    if misfit_sd.device.type == "cpu" and native.available() and not needs_gradient(*inputs):
        scene = scene_from_parameters(shape, parameters, native.outlines(shape, parameters))
        return compiled_likelihood(scene, misfit_sd, history, field, settings, least, innovations)
    scene = scene_from_parameters(shape, parameters)
    return _filter(scene, misfit_sd, history, field, settings, innovations)


def _filter(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    innovations: bool = False,
) -> HistoryLikelihood:
    finite = torch.isfinite(misfit_sd)
    sd = torch.where(finite, misfit_sd, 0.0)
    count = field.bumps * len(scene.terrains)
    state = first_state(sd, count, history.variance[0])
    total = torch.zeros_like(misfit_sd)
    each: list[Innovation] = []
    for k in range(len(history)):
        transition = simulate_step(
            scene,
            history.poses[k] - state.mean[:, count:],
            history.command[k],
            history.stiffness,
            settings,
            previous=history.previous[k],
        )
        residual = history.settled[k] - transition.pose
        residual = torch.cat((residual[:, :2], wrap_angle(residual[:, 2:])), dim=-1)
        rows, uncovered = misfit_rows(field, sd, history.settled[k, 2], transition)
        usable = (transition.status <= int(StepStatus.RELAXED)) & finite
        usable = usable & torch.isfinite(residual).all(-1)
        # What is not usable must not reach a factorisation.
        parts = (residual, rows, transition.pose_from_start, uncovered)
        residual, rows, from_start, uncovered = (
            torch.where(usable.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0) for part in parts
        )
        variance = history.variance[k + 1]
        state, found = assimilate(state, residual, rows, from_start, variance, uncovered)
        total = total + torch.where(usable, found.log_density, -torch.inf)
        if innovations:
            parts = (found.whitened, found.log_scale)
            each.append(Innovation(*(torch.where(usable[:, None], p, torch.nan) for p in parts)))
    mean, covariance = state.mean[:, :count], state.covariance[:, :count, :count]
    if not innovations:
        return HistoryLikelihood(total, mean, covariance)
    whitened = torch.stack([one.whitened for one in each], dim=1)
    log_scale = torch.stack([one.log_scale for one in each], dim=1)
    return HistoryLikelihood(total, mean, covariance, whitened, log_scale)


def compiled_likelihood(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    least: Tensor | None,
    innovations: bool,
    by_theta: SceneSlopes | None = None,
) -> HistoryLikelihood:
    """The same in compiled loops; particles that jam are left to `_filter`."""
    from tpcd.belief.kernel import Found, Measured, explain_range
    from tpcd.simulator.kernel_slopes import SceneSlopes

    count = len(misfit_sd)
    size = field.bumps * len(scene.terrains)
    values, slopes = field.basis(history.settled[:, 2])
    highest = highest_terms(history)
    # What the transitions after each one can still add.
    rest = torch.cat((highest.flip(0).cumsum(0).flip(0)[1:], highest.new_zeros(1)))
    if least is None:
        least = misfit_sd.new_full((count,), -torch.inf)
    measured = Measured(
        history.poses.contiguous().numpy(),
        history.variance.contiguous().numpy(),
        values.numpy(),
        slopes.numpy(),
        rest.numpy(),
        least.contiguous().numpy(),
        misfit_sd.contiguous().numpy(),
        OUTLIER_SQUARE,
    )
    total = torch.empty(count, dtype=torch.float64)
    mean = torch.zeros(count, size, dtype=torch.float64)
    covariance = torch.zeros(count, size, size, dtype=torch.float64)
    jammed = torch.zeros(count, dtype=torch.bool)
    shape = (count if innovations else 0, len(history), 3)
    whitened, log_scale = (total.new_full(shape, torch.nan) for _ in range(2))
    if by_theta is None:
        flat = np.zeros((1, 0, len(scene.terrains)))
        by_theta = SceneSlopes(np.zeros((1, 0, 2, 1)), flat, flat)
    slopes = total.new_full((shape[0], by_theta.offsets.shape[1], *shape[1:]), torch.nan)
    answers = (total, mean, covariance, jammed, whitened, log_scale, slopes)
    found = Found(*(value.numpy() for value in answers))
    world, law = native.world_of(scene), native.law_of(history.stiffness, settings)
    request = native.request_of(
        torch.zeros(len(history), dtype=torch.int64),
        history.start,
        history.previous,
        history.command,
        settings,
    )
    native.in_parts(
        lambda first, last: explain_range(
            world, law, request, measured, by_theta, found, first, last
        ),
        count,
        len(history),
    )
    answer = HistoryLikelihood(total, mean, covariance)
    if innovations:
        answer = replace(answer, whitened=whitened, log_scale=log_scale, slopes=slopes)
    index = torch.nonzero(jammed).flatten()
    if len(index):
        part = _filter(scene.gather(index), misfit_sd[index], history, field, settings, innovations)
        for name, value in vars(part).items():
            if value is not None:
                getattr(answer, name)[index] = value
    return answer


def _without(
    hopeless: Tensor,
    shape: Shape,
    parameters: Parameters,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    least: Tensor,
) -> HistoryLikelihood:
    """Evaluate only the particles with a chance; the others are impossible."""
    index = torch.nonzero(~hopeless).flatten()
    kept = Parameters.from_vector(parameters.to_vector()[index])
    part = history_likelihood(shape, kept, misfit_sd[index], history, field, settings, least[index])
    whole = {}
    for name, value in vars(part).items():
        if value is None:
            continue
        fill = -torch.inf if name == "total" else 0.0
        empty = value.new_full((len(hopeless), *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return HistoryLikelihood(**whole)


def highest_terms(history: History) -> Float[Tensor, " n"]:
    """What the log density of each transition's residual cannot exceed, whatever theta is."""
    return -0.5 * (2 * math.pi * history.variance[1:]).log().sum(-1)
