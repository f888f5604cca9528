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
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.kalman import OUTLIER_SQUARE, assimilate, first_state
from tpcd.belief.misfit import MisfitField, misfit_rows
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, native, simulate_step
from tpcd.simulator.step import needs_gradient


@dataclass(frozen=True)
class Threshold:
    """What a particle must reach: before + temperature * (total - before) >= `least`."""

    least: Float[Tensor, " m"]
    temperature: float = 1.0


@dataclass(frozen=True)
class HistoryLikelihood:
    """What theta says about a history, m particles.

    `total` is the log likelihood of all transitions and `before` of all but the last, both
    -inf for a particle that was given up; `field_mean` and `field_covariance` the normal
    posterior of the misfit coefficients.
    """

    total: Float[Tensor, " m"]
    before: Float[Tensor, " m"]
    field_mean: Float[Tensor, "m c"]
    field_covariance: Float[Tensor, "m c c"]


def history_likelihood(
    shape: Shape,
    parameters: Parameters,
    misfit_sd: Float[Tensor, " m"],
    history: History,
    field: MisfitField,
    settings: StepSettings,
    threshold: Threshold | None = None,
) -> HistoryLikelihood:
    """Evaluate m particles, each with its own size of the outline misfit, on n transitions."""
    if threshold is not None:
        hopeless = threshold.least == torch.inf
        if bool(hopeless.any()):
            return _without(
                hopeless, shape, parameters, misfit_sd, history, field, settings, threshold
            )
    inputs = (parameters.to_vector(), misfit_sd)
    if misfit_sd.device.type == "cpu" and native.available() and not needs_gradient(*inputs):
        scene = scene_from_parameters(shape, parameters, native.outlines(shape, parameters))
        return _compiled(scene, misfit_sd, history, field, settings, threshold)
    scene = scene_from_parameters(shape, parameters)
    return _filter(scene, misfit_sd, history, field, settings)


def _filter(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
) -> HistoryLikelihood:
    finite = torch.isfinite(misfit_sd)
    sd = torch.where(finite, misfit_sd, 0.0)
    count = field.bumps * len(scene.terrains)
    state = first_state(sd, count, history.variance[0])
    before = total = torch.zeros_like(misfit_sd)
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
        state, gain = assimilate(state, residual, rows, from_start, variance, uncovered)
        before, total = total, total + torch.where(usable, gain, -torch.inf)
    mean, covariance = state.mean[:, :count], state.covariance[:, :count, :count]
    return HistoryLikelihood(total, before, mean, covariance)


def _compiled(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    threshold: Threshold | None,
) -> HistoryLikelihood:
    """The same in compiled loops; particles that jam are left to `_filter`."""
    from tpcd.belief.kernel import Found, Measured, explain_range

    count = len(misfit_sd)
    size = field.bumps * len(scene.terrains)
    values, slopes = field.basis(history.settled[:, 2])
    highest = highest_terms(history)
    temperature = 1.0 if threshold is None else threshold.temperature
    highest = torch.cat((highest[:-1], temperature * highest[-1:]))
    # What the transitions after each one can still add.
    rest = torch.cat((highest.flip(0).cumsum(0).flip(0)[1:], highest.new_zeros(1)))
    least = misfit_sd.new_full((count,), -torch.inf) if threshold is None else threshold.least
    measured = Measured(
        history.poses.contiguous().numpy(),
        history.variance.contiguous().numpy(),
        values.numpy(),
        slopes.numpy(),
        rest.numpy(),
        least.contiguous().numpy(),
        temperature,
        misfit_sd.contiguous().numpy(),
        OUTLIER_SQUARE,
    )
    total, before = (torch.empty(count, dtype=torch.float64) for _ in range(2))
    mean = torch.zeros(count, size, dtype=torch.float64)
    covariance = torch.zeros(count, size, size, dtype=torch.float64)
    jammed = torch.zeros(count, dtype=torch.bool)
    found = Found(*(v.numpy() for v in (total, before, mean, covariance, jammed)))
    world, law = native.world_of(scene), native.law_of(history.stiffness, settings)
    request = native.request_of(
        torch.zeros(len(history), dtype=torch.int64),
        history.start,
        history.previous,
        history.command,
        settings,
    )
    native.in_parts(
        lambda first, last: explain_range(world, law, request, measured, found, first, last), count
    )
    answer = HistoryLikelihood(total, before, mean, covariance)
    index = torch.nonzero(jammed).flatten()
    if len(index):
        part = _filter(scene.gather(index), misfit_sd[index], history, field, settings)
        for name, value in vars(part).items():
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
    threshold: Threshold,
) -> HistoryLikelihood:
    """Evaluate only the particles with a chance; the others are impossible."""
    index = torch.nonzero(~hopeless).flatten()
    kept = Parameters.from_vector(parameters.to_vector()[index])
    least = Threshold(threshold.least[index], threshold.temperature)
    part = history_likelihood(shape, kept, misfit_sd[index], history, field, settings, least)
    whole = {}
    for name, value in vars(part).items():
        fill = -torch.inf if name in ("total", "before") else 0.0
        empty = value.new_full((len(hopeless), *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return HistoryLikelihood(**whole)


def highest_terms(history: History) -> Float[Tensor, " n"]:
    """What the log density of each transition's residual cannot exceed, whatever theta is."""
    return -0.5 * (2 * math.pi * history.variance[1:]).log().sum(-1)
