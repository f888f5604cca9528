"""The history likelihood with derivatives of its innovations, for Newton steps and proposals."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.decoding import decode
from tpcd.belief.filter import HistoryLikelihood, filter_history
from tpcd.belief.history import History
from tpcd.belief.likelihood import effective_setting
from tpcd.belief.misfit import MisfitField
from tpcd.contact import place_points, scene_from_parameters
from tpcd.effects.conditions import Outcome
from tpcd.effects.protocol import Added
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings

_DIFFERENCE = 1e-3
"""Difference of a coordinate by which a scene moves for its derivatives."""


class Linearised(NamedTuple):
    """The likelihood with derivatives, that with another misfit, and what effects answer to."""

    found: HistoryLikelihood
    moved_misfit: HistoryLikelihood | None
    outcome: Outcome | None


def linearised_likelihood(
    shape: Shape,
    vectors: Float[Tensor, "m d"],
    slopes: Float[Tensor, "m d"],
    misfit_sd: Float[Tensor, " m"],
    history: History,
    field: MisfitField,
    settings: StepSettings,
    added: Added | None = None,
    moved_sd: Float[Tensor, " m"] | None = None,
) -> Linearised:
    """The likelihood with the derivatives of its innovations by d coordinates, in compiled loops,
    and, without derivatives, that with a misfit of `moved_sd` [m] instead.

    `vectors` are theta, and `slopes` the derivatives of each entry by its own coordinate. The
    scene moves by differences, the settled poses by the derivatives of the rest equations,
    and the filter at a fixed gain (Gauss-Newton). Effects are taken
    as they are, as if theta did not change how they act.
    """
    from tpcd.belief.kernel_given import SceneSlopes

    m, d = vectors.shape
    z = shape.latent_dim
    steps = torch.diag(torch.full((d,), _DIFFERENCE, dtype=vectors.dtype))
    moved = torch.cat((vectors[None], vectors + steps[:, None] * slopes))
    decoded = Parameters.from_vector(moved[: z + 1].flatten(0, 1)).latent
    points = decode(shape, decoded).unflatten(0, (z + 1, m))
    points = torch.cat((points, points[:1].expand(d - z, -1, -1, -1)))
    parameters = Parameters.from_vector(moved)
    scenes = scene_from_parameters(
        shape, parameters, place_points(points, parameters.scale, parameters.mount)
    )
    offsets = torch.stack([body.offset for body in scenes.terrains], dim=-1)
    parts = []
    for value in (scenes.points_ee.mT, offsets, scenes.friction):
        moves = (value[1:] - value[0]).transpose(0, 1).contiguous() / _DIFFERENCE
        parts.append(moves.detach().numpy())
    first = Parameters.from_vector(vectors)
    scene = scene_from_parameters(shape, first, place_points(points[0], first.scale, first.mount))
    setting, outcome = history.setting(scene), None
    if added is not None and added.effects:
        setting, outcome = effective_setting(scene, history, misfit_sd, field, settings, added)
    points_ee, sd = scene.points_ee, misfit_sd
    if moved_sd is not None:
        twice = torch.arange(m).repeat(2)
        points_ee, sd, setting = points_ee[twice], torch.cat((sd, moved_sd)), setting[twice]
        parts = [np.concatenate((part, np.zeros_like(part))) for part in parts]
    found = filter_history(
        points_ee, setting, sd, field, settings, innovations=True, by_theta=SceneSlopes(*parts)
    )
    if moved_sd is None:
        return Linearised(found, None, outcome)
    moved_misfit = replace(found[m:], slopes=None)
    return Linearised(found[:m], moved_misfit, outcome)
