"""Rows simulated under effects: the step solved in passes, and what sensors then read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.effects.conditions import (
    Conditions,
    Outcome,
    Rows,
    angle_difference,
    base_conditions,
    sequence,
)
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
    gap: Float[Tensor, "m r t"] | None = None,
) -> SimulatedRows:
    """Settle every row from the start pose it has in `rows`; scenes and effects of m particles.

    `passes` replaces the number that the effects ask for. Terrains are further away by the
    `gap` [m]. Rows that follow no other have no
    answer, but what they are loaded with where the arm rests off its command.
    """
    base = base_conditions(scene, commands, stiffness)
    follows = rows.follows != torch.arange(len(commands))
    rests = (rows.starts != commands).any(-1)
    rests = rests if rests.ndim == 1 else rests.any(0)
    index, loaded = (torch.nonzero(which).flatten() for which in (follows, follows | rests))
    outcome = outcome_in_parts(scene, base, rows, loaded, added, settings, gap)
    for k in range(added.passes if passes is None else passes):
        conditions = added.apply(base, rows, outcome)
        transition = _settle(scene, conditions, rows, loaded, settings, gap)
        outcome = _outcome(scene, transition, rows, loaded, first=k == 0).after(outcome)
    conditions = added.apply(base, rows, outcome)
    return _read(_settle(scene, conditions, rows, index, settings, gap), conditions, index)


def outcome_in_parts(
    scene: ContactScene,
    base: Conditions,
    rows: Rows,
    index: Int[Tensor, " n"],
    added: Added,
    settings: StepSettings,
    gap: Float[Tensor, "m r t"] | None = None,
) -> Outcome | None:
    """How the rows at `index` settle where effects ask for a way in parts, each of which answers to
    where the one before ended; None where they do not."""
    if added.parts < 2:
        return None
    outcome = _at_rest(scene, rows)
    rough, here = replace(settings, finest=1.0), None
    for part in range(added.parts):
        conditions = added.apply(base, rows, outcome)
        span = part / added.parts, (part + 1) / added.parts
        transition = _settle(scene, conditions, rows, index, rough, gap, span, here)
        here = transition.pose - _moved(conditions, index)
        outcome = _outcome(scene, transition, rows, index, first=part == 0).between(outcome)
    return outcome


class RowByRow:
    """Rows one after the other, each settled from where the caller says, for m particles.

    A row follows the one before; effects that look back see what truly happened to each particle.
    """

    def __init__(
        self,
        scene: ContactScene,
        commands: Float[Tensor, "r 3"],
        stiffness: Float[Tensor, " 3"],
        added: Added,
        settings: StepSettings,
        start: Float[Tensor, " 3"],
        gap: Float[Tensor, "m r t"] | None = None,
    ) -> None:
        """All commands of the run; row 0 is the start pose [m, m, rad]. Terrains are further away
        by the `gap` [m]."""
        self._gap = gap
        self._scene, self._added, self._settings = scene, added, settings
        self._base = base_conditions(scene, commands, stiffness)
        self._rows = sequence(start.expand(len(commands), 3))
        self._first = added.apply(self._base, self._rows, None)
        self._past = _at_rest(scene, self._rows)
        if added.passes:
            self.settle(0, start.expand(len(scene.friction), 3))

    def settle(self, row: int, start: Float[Tensor, "m 3"]) -> SimulatedRows:
        """Settle the next row from the poses [m, m, rad] where the one before ended."""
        index = torch.tensor([row])
        here = index == torch.arange(len(self._rows.share))
        starts = torch.where(here[:, None], start[:, None], self._past.pose)
        rows = replace(self._rows, starts=starts)
        conditions = self._first
        now = outcome_in_parts(
            self._scene, self._base, rows, index, self._added, self._settings, self._gap
        )
        if now is not None:
            seen = _with_row(self._past, now, here)
            conditions = self._added.apply(self._base, rows, seen)
        for left in range(self._added.passes, -1, -1):
            transition = _settle(self._scene, conditions, rows, index, self._settings, self._gap)
            first = left == self._added.passes
            now = _outcome(self._scene, transition, rows, index, first).after(now)
            seen = _with_row(self._past, now, here)
            if left:
                conditions = self._added.apply(self._base, rows, seen)
        self._past = seen
        return _read(transition, conditions, index)


def _read(transition: Transition, conditions: Conditions, index: Tensor) -> SimulatedRows:
    """What sensors read of the rows that settled."""
    pose = transition.pose
    offset = pose - _at(conditions.command, index)
    turn = torch.remainder(offset[..., 2:] + torch.pi, 2 * torch.pi) - torch.pi
    offset = torch.cat((offset[..., :2], turn), dim=-1)
    true = _at(conditions.stiffness, index) * offset
    sensor = _at(conditions.sensor, index)
    read = (sensor @ true[..., None])[..., 0] + _at(conditions.bias, index)
    matrix = sensor * _at(conditions.stiffness, index)[..., None, :]
    shape = pose.shape[:2]
    return SimulatedRows(
        index,
        replace(transition, wrench=true),
        matrix.expand(*shape, 3, 3),
        read.expand(*shape, 3),
    )


def _settle(
    scene: ContactScene,
    conditions: Conditions,
    rows: Rows,
    index: Tensor,
    settings: StepSettings,
    gap: Tensor | None,
    span: tuple[float, float] = (0.0, 1.0),
    begin: Tensor | None = None,
) -> Transition:
    """Settle rows after a part of their way, from where they start or from `begin`."""
    here = conditions.scene(scene.points_ee[:, None])
    if here.batch_shape[1] > 1:
        here = here.columns(index)
    if gap is not None:
        here = here.further(gap[:, index])
    before = rows.follows[index]
    target, turn = conditions.target, conditions.turned
    starts, commands, previous = torch.broadcast_tensors(
        rows.starts[..., index, :] + _at(turn, before),
        _at(target - conditions.carried, index) + _at(turn, index),
        _at(target, before) + _at(turn, before),
    )
    if begin is not None:
        starts = begin
    if span != (0.0, 1.0):
        first, way = previous, angle_difference(commands, previous)
        previous, commands = (first + share * way for share in span)
    stiffness = _at(conditions.stiffness, index)
    transition = simulate_step(
        here, starts, commands, stiffness, settings, previous=previous, unusual=True
    )
    return replace(transition, pose=transition.pose + _moved(conditions, index))


def _moved(conditions: Conditions, index: Tensor) -> Tensor:
    """From the pose of the object as seen from the ground to that of the end effector."""
    return _at(conditions.give, index) - _at(conditions.turned, index)


def _at_rest(scene: ContactScene, rows: Rows) -> Outcome:
    """All rows where they start, without contact."""
    m, terrains = scene.friction.shape
    pose = rows.starts.expand(m, -1, -1)
    contacts = pose.new_zeros(m, pose.shape[1], terrains, 4)
    return Outcome.of(pose, contacts[..., 0].long(), contacts, scene.points_ee.expand(m, -1, -1))


def _with_row(past: Outcome, now: Outcome, here: Tensor) -> Outcome:
    """An outcome with the rows `here` of another one."""
    both = zip(vars(now).items(), vars(past).values(), strict=True)
    rows = {
        name: new if name == "outline" else torch.where(_along(here, new), new, old)
        for (name, new), old in both
    }
    return Outcome(**rows)


def _outcome(
    scene: ContactScene, transition: Transition, rows: Rows, index: Tensor, first: bool
) -> Outcome:
    m, terrains = len(transition.pose), transition.mode.shape[-1]
    starts = rows.starts.expand(m, -1, -1)
    pose = starts.clone()
    pose[:, index] = transition.pose
    alone = (rows.follows == torch.arange(len(rows.follows)))[:, None]
    pose = torch.where(alone, starts, pose)
    mode = torch.zeros(m, len(rows.share), terrains, dtype=torch.long)
    mode[:, index] = transition.mode
    contacts = pose.new_zeros(m, len(rows.share), terrains, 4)
    contacts[:, index] = transition.contacts.nan_to_num(0.0)
    return Outcome.of(pose, mode, contacts, scene.points_ee.expand(m, -1, -1), first)


def _along(rows: Tensor, value: Tensor) -> Tensor:
    """A mask of rows against values (m, r, ...)."""
    return rows.reshape(1, -1, *[1] * (value.ndim - 2))


def _at(value: Tensor, index: Tensor) -> Tensor:
    """The value (m, r, ...) at some rows; r may be 1."""
    return value if value.shape[1] == 1 else value[:, index]
