"""Likelihood of a history given theta: every datum once, noise propagated, misfit integrated.

Each particle steps every transition from its filtered start pose and filters the residual as
`filter` says, which integrates the misfit field and the reading errors out. A particle whose
step fails or is not finite gets log likelihood -inf; one that has not quite converged counts.

A sampler that has drawn its random number already knows what log likelihood a proposal must
reach. No term can exceed the density of its reading's own noise at zero, log N(0; 0, R_k), so
that a proposal may be given up once even that would not lift it over its threshold (`least`).
This changes no decision; it spares most of the cost of bad proposals.

Where a recording begins in free space, no particle may have the object inside of floor or
wall there, which no transition would tell (`free_start`).

Effects change the conditions of the steps. Those that answer to an outcome (a grip that
yields sideways) are solved in passes: each takes the outcome under the conditions before.
Their likelihood also holds what the readings of pose and wrench say about each other, relative
to the same without effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.decoding import outlines
from tpcd.belief.filter import HistoryLikelihood, Steps, filter_history, joined
from tpcd.belief.free_start import free_starts, start_gaps
from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.setting import Setting, merge
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.effects.conditions import Outcome
from tpcd.effects.protocol import Added, Effect, parts_of
from tpcd.effects.simulate import outcome_in_parts
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings

AT_ONCE = 64
"""Particles of an uneven floor that are evaluated together: each row of each has an outline of its
own, more of which than the processor's cache holds take longer."""


def in_groups(effects: Sequence[Effect], count: int) -> bool:
    """Whether so many particles with these effects are evaluated `AT_ONCE` by `AT_ONCE`."""
    return parts_of(effects) > 1 and count > 1.5 * AT_ONCE


def history_likelihood(
    shape: Shape,
    parameters: Parameters,
    misfit_sd: Float[Tensor, " m"],
    history: History,
    field: MisfitField,
    settings: StepSettings,
    least: Float[Tensor, " m"] | None = None,
    innovations: bool = False,
    added: Added | None = None,
    outcome: Outcome | None = None,
    steps: bool = False,
) -> HistoryLikelihood:
    """Evaluate m particles, each with its own size of the outline misfit, on n transitions.

    Effects answer to the `outcome` if one is given: not quite theirs, but at the cost of one pass.
    With `steps` the answer tells how the transitions settled.
    """
    if least is not None and not innovations:
        hopeless = least == torch.inf
        if bool(hopeless.any()):
            index = torch.nonzero(~hopeless).flatten()
            part = history_likelihood(
                shape,
                Parameters.from_vector(parameters.to_vector()[index]),
                misfit_sd[index],
                history,
                field,
                settings,
                least[index],
                added=None if added is None else added[index],
                outcome=None if outcome is None else outcome[index],
            )
            return _spread(part, index, len(hopeless))
    inputs = (parameters.to_vector(), misfit_sd)
    if added is not None and in_groups(added.effects, len(misfit_sd)):
        given = (least, added, outcome)
        found = []
        for index in torch.arange(len(misfit_sd)).split(AT_ONCE):
            bounds, effects, answered = (one if one is None else one[index] for one in given)
            some = (Parameters.from_vector(inputs[0][index]), misfit_sd[index], history, field)
            options = (settings, bounds, innovations, effects, answered, steps)
            found.append(history_likelihood(shape, *some, *options))
        return joined(found)
    scene = scene_from_parameters(shape, parameters, outlines(shape, parameters))
    setting = history.setting(scene)
    further = torch.zeros_like(misfit_sd)
    if added is not None and added.effects:
        setting, _ = effective_setting(scene, history, misfit_sd, field, settings, added, outcome)
        read = history.read
        further = setting.merged.log_parity(read) - history.merged.log_parity(read)
        least = None if least is None else least - further
    starts, begins = None, free_starts(history)
    if len(begins):
        starts = start_gaps(scene.points_ee, setting, history.poses[:, 2], begins)
        if least is not None:
            highest = starts.log_free_before(field, misfit_sd) + setting.highest_terms.sum(-1)
            least = torch.where(highest > least, least, torch.inf)
    arguments = (scene.points_ee, setting, misfit_sd, field, settings)
    found = filter_history(*arguments, least, innovations, steps)
    if starts is not None:
        further = further + starts.log_free(
            field, misfit_sd, found.field_mean, found.field_covariance
        )
    return replace(found, total=found.total + further)


def effective_setting(
    scene: ContactScene,
    history: History,
    misfit_sd: Float[Tensor, " m"],
    field: MisfitField,
    settings: StepSettings,
    added: Added,
    outcome: Outcome | None = None,
) -> tuple[Setting, Outcome | None]:
    """The history under the effects of each particle, and the outcome that they answer to: the
    one that is given, or else that of as many passes as they need."""
    base = history.setting(scene)
    passes = added.passes if outcome is None else 0
    if outcome is None:
        moves = torch.nonzero(~history.seams).flatten() + 1
        outcome = outcome_in_parts(scene, base.conditions, history.rows, moves, added, settings)
    for k in range(passes):
        # What a row is loaded with counts for the next one, also where its transition does not.
        setting = replace(_answering(base, history, added, outcome), used=~history.seams)
        arguments = (scene.points_ee, setting, misfit_sd, field, settings)
        found = filter_history(*arguments, steps=True)
        assert found.steps is not None
        now = outcome_of(found.steps, history, setting.used, scene.points_ee, first=k == 0)
        outcome = now.after(outcome)
    return _answering(base, history, added, outcome), outcome


def _answering(base: Setting, history: History, added: Added, outcome: Outcome | None) -> Setting:
    conditions = added.apply(base.conditions, history.rows, outcome)
    merged = merge(history.readings, history.sensor_variance, conditions)
    return replace(base, conditions=conditions, merged=merged)


def outcome_of(
    steps: Steps,
    history: History,
    used: Bool[Tensor, " n"],
    points_ee: Float[Tensor, "m p 2"],
    first: bool = False,
) -> Outcome:
    """The settled rows: those of the transitions in use, and readings where none leads to a row."""
    m = len(steps.pose)
    pose = history.readings[:, :3].expand(m, -1, -1).clone()
    stepped = used & steps.contacts.isfinite().all(-1).all(-1)
    pose[:, 1:] = torch.where(stepped[..., None], steps.pose, pose[:, 1:])
    mode, contacts = (
        torch.cat((value.new_zeros(m, 1, *value.shape[2:]), value), dim=1)
        for value in (steps.mode, steps.contacts.nan_to_num(0.0))
    )
    return Outcome.of(pose, mode, contacts, points_ee, first)


def highest_terms(history: History) -> Float[Tensor, " n"]:
    """What the log density of each transition's residual cannot exceed, whatever theta is."""
    return Setting(history.bare, history.merged, history.used, history.settled[:, 2]).highest_terms[
        0
    ]


def _spread(part: HistoryLikelihood, index: Tensor, count: int) -> HistoryLikelihood:
    """The answers of some particles among those of all; the others are impossible."""
    whole = {}
    for name, value in vars(part).items():
        if value is None:
            continue
        fill = -torch.inf if name == "total" else 0.0
        empty = value.new_full((count, *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return HistoryLikelihood(**whole)
