"""Rows simulated under effects: the step solved in passes, and what sensors then read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.effects.conditions import Conditions, Outcome, Rows, base_conditions
from tpcd.effects.protocol import Added
from tpcd.simulator import StepSettings, Transition, simulate_step


@dataclass(frozen=True)
class SimulatedRows:
    """The n rows that follow another one, for m particles."""

    index: Int[Tensor, " n"]
    """Their positions among all rows."""
    transition: Transition
    """Batch (m, n); `pose` is that of the end effector, `wrench` what acts on it."""
    matrix: Float[Tensor, "m n 3 3"]
    """How the wrench that is read answers the settled pose."""
    wrench: Float[Tensor, "m n 3"]
    """The wrench that is read [N, N, N·m]."""


def simulate_rows(
    scene: ContactScene,
    rows: Rows,
    commands: Float[Tensor, "r 3"],
    stiffness: Float[Tensor, " 3"],
    added: Added,
    settings: StepSettings,
    passes: int | None = None,
) -> SimulatedRows:
    """Settle every row from the start pose it has in `rows`; scenes and effects of m particles.

    `passes` replaces the number that the effects ask for.
    """
    base = base_conditions(scene, commands, stiffness)
    place = torch.arange(len(commands))
    index = torch.nonzero(rows.follows != place).flatten()
    outcome = None
    for _ in range((added.passes if passes is None else passes) + 1):
        conditions = added.apply(base, rows, outcome)
        transition = _settle(scene, conditions, rows, index, settings)
        outcome = _outcome(transition, rows, index)
    give = _at(conditions.give, index)
    pose = transition.pose + give
    offset = pose - _at(conditions.command, index)
    turn = torch.remainder(offset[..., 2:] + torch.pi, 2 * torch.pi) - torch.pi
    offset = torch.where(give.new_tensor([False, False, True]).bool(), turn, offset)
    true = _at(conditions.stiffness, index) * offset
    sensor = _at(conditions.sensor, index)
    read = (sensor @ true[..., None])[..., 0] + _at(conditions.bias, index)
    matrix = sensor * _at(conditions.stiffness, index)[..., None, :]
    shape = pose.shape[:2]
    return SimulatedRows(
        index,
        replace(transition, pose=pose, wrench=true),
        matrix.expand(*shape, 3, 3),
        read.expand(*shape, 3),
    )


def _settle(
    scene: ContactScene, conditions: Conditions, rows: Rows, index: Tensor, settings: StepSettings
) -> Transition:
    here = conditions.scene(scene.points_ee[:, None])
    if here.batch_shape[1] > 1:
        here = here.columns(index)
    before = rows.follows[index]
    target, turn = conditions.target, _pose(conditions.turn)
    transition = simulate_step(
        here,
        rows.starts[index] + _at(turn, before),
        _at(target, index) + _at(turn, index),
        _at(conditions.stiffness, index),
        settings,
        previous=_at(target, before) + _at(turn, before),
    )
    return replace(transition, pose=transition.pose - _at(turn, index))


def _outcome(transition: Transition, rows: Rows, index: Tensor) -> Outcome:
    m, terrains = len(transition.pose), transition.mode.shape[-1]
    pose = rows.starts.expand(m, -1, -1).clone()
    pose[:, index] = transition.pose
    mode = torch.zeros(m, len(rows.share), terrains, dtype=torch.long)
    mode[:, index] = transition.mode
    contacts = pose.new_zeros(m, len(rows.share), terrains, 4)
    contacts[:, index] = transition.contacts.nan_to_num(0.0)
    return Outcome(pose, mode, contacts[..., 0], contacts[..., 1], contacts[..., 2:])


def _at(value: Tensor, index: Tensor) -> Tensor:
    """The value (m, r, ...) at some rows; r may be 1."""
    return value if value.shape[1] == 1 else value[:, index]


def _pose(turn: Tensor) -> Tensor:
    """The turn as a change of pose."""
    return torch.cat((torch.zeros_like(turn), torch.zeros_like(turn), turn), dim=-1)
