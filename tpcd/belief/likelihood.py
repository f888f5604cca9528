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
from tpcd.contact import ContactScene, place_points, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, native, simulate_step
from tpcd.simulator.step import needs_gradient

if TYPE_CHECKING:
    from tpcd.simulator.kernel_slopes import SceneSlopes


_DIFFERENCE = 1e-3
"""Difference of a coordinate by which a scene moves for its derivatives."""


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
    posterior of the misfit coefficients. Where they are asked for, `whitened` and `log_scale`
    are the innovations of the n transitions (see `kalman.Innovation`), NaN without one, and
    `slopes` the derivatives of `whitened` by d coordinates.
    """

    total: Float[Tensor, " m"]
    before: Float[Tensor, " m"]
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
    threshold: Threshold | None = None,
    innovations: bool = False,
) -> HistoryLikelihood:
    """Evaluate m particles, each with its own size of the outline misfit, on n transitions."""
    if threshold is not None and not innovations:
        hopeless = threshold.least == torch.inf
        if bool(hopeless.any()):
            return _without(
                hopeless, shape, parameters, misfit_sd, history, field, settings, threshold
            )
    inputs = (parameters.to_vector(), misfit_sd)
    if misfit_sd.device.type == "cpu" and native.available() and not needs_gradient(*inputs):
        scene = scene_from_parameters(shape, parameters, native.outlines(shape, parameters))
        return _compiled(scene, misfit_sd, history, field, settings, threshold, innovations)
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
    before = total = torch.zeros_like(misfit_sd)
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
        before, total = total, total + torch.where(usable, found.log_density, -torch.inf)
        if innovations:
            parts = (found.whitened, found.log_scale)
            each.append(Innovation(*(torch.where(usable[:, None], p, torch.nan) for p in parts)))
    mean, covariance = state.mean[:, :count], state.covariance[:, :count, :count]
    if not innovations:
        return HistoryLikelihood(total, before, mean, covariance)
    whitened = torch.stack([one.whitened for one in each], dim=1)
    log_scale = torch.stack([one.log_scale for one in each], dim=1)
    return HistoryLikelihood(total, before, mean, covariance, whitened, log_scale)


def _compiled(
    scene: ContactScene,
    misfit_sd: Tensor,
    history: History,
    field: MisfitField,
    settings: StepSettings,
    threshold: Threshold | None,
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
    shape = (count if innovations else 0, len(history), 3)
    whitened, log_scale = (total.new_full(shape, torch.nan) for _ in range(2))
    if by_theta is None:
        flat = np.zeros((1, 0, len(scene.terrains)))
        by_theta = SceneSlopes(np.zeros((1, 0, 2, 1)), flat, flat)
    slopes = total.new_full((shape[0], by_theta.offsets.shape[1], *shape[1:]), torch.nan)
    answers = (total, before, mean, covariance, jammed, whitened, log_scale, slopes)
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
    answer = HistoryLikelihood(total, before, mean, covariance)
    if innovations:
        answer = replace(answer, whitened=whitened, log_scale=log_scale, slopes=slopes)
    index = torch.nonzero(jammed).flatten()
    if len(index):
        part = _filter(scene.gather(index), misfit_sd[index], history, field, settings, innovations)
        for name, value in vars(part).items():
            if value is not None:
                getattr(answer, name)[index] = value
    return answer


def linearised_likelihood(
    shape: Shape,
    vectors: Float[Tensor, "m d"],
    slopes: Float[Tensor, "m d"],
    misfit_sd: Float[Tensor, " m"],
    history: History,
    field: MisfitField,
    settings: StepSettings,
) -> HistoryLikelihood:
    """The likelihood with the derivatives of its innovations by d coordinates, in compiled loops.

    `vectors` are theta, and `slopes` the derivatives of each entry by its own coordinate. The
    scene moves by differences, the settled poses by the derivatives of the rest equations,
    and the filter at a fixed gain (Gauss-Newton). NaN where a particle jams.
    """
    from tpcd.simulator.kernel_slopes import SceneSlopes

    m, d = vectors.shape
    z = shape.latent_dim
    steps = torch.diag(torch.full((d,), _DIFFERENCE, dtype=vectors.dtype))
    moved = torch.cat((vectors[None], vectors + steps[:, None] * slopes))
    decoded = Parameters.from_vector(moved[: z + 1].flatten(0, 1)).latent
    points = native.decode(shape, decoded).unflatten(0, (z + 1, m))
    points = torch.cat((points, points[:1].expand(d - z, -1, -1, -1)))
    parameters = Parameters.from_vector(moved)
    world = native.world_of(
        scene_from_parameters(
            shape, parameters, place_points(points, parameters.scale, parameters.mount)
        )
    )
    parts = []
    for flat in (world.points, world.offsets, world.friction):
        value = flat.reshape(d + 1, m, *flat.shape[1:])
        parts.append(np.ascontiguousarray((value[1:] - value[0]).swapaxes(0, 1)) / _DIFFERENCE)
    first = Parameters.from_vector(vectors)
    scene = scene_from_parameters(shape, first, place_points(points[0], first.scale, first.mount))
    return _compiled(scene, misfit_sd, history, field, settings, None, True, SceneSlopes(*parts))


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
        if value is None:
            continue
        fill = -torch.inf if name in ("total", "before") else 0.0
        empty = value.new_full((len(hopeless), *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return HistoryLikelihood(**whole)


def highest_terms(history: History) -> Float[Tensor, " n"]:
    """What the log density of each transition's residual cannot exceed, whatever theta is."""
    return -0.5 * (2 * math.pi * history.variance[1:]).log().sum(-1)
