"""The quasi-static model with effects as a source of simulated truth, with a known outline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.effects.catalogue import KNOWN, find_effect
from tpcd.effects.conditions import sequence
from tpcd.effects.protocol import Added, Effect
from tpcd.effects.simulate import simulate_rows
from tpcd.simulator.record import StepSettings, StepStatus
from tpcd.simulator.truth import TRUTH_SETTINGS
from tpcd.terrain import floor, wall

TRUE_PASSES = 8
"""Passes in which the effects settle; the estimator makes do with one to three."""


def added_effects(
    hidden: Mapping[str, Mapping[str, float]], among: Sequence[Effect] = KNOWN
) -> Added:
    """Effects with given parameters in SI units; what is not given has its null value.

    Raises ValueError for an unknown effect or parameter.
    """
    effects, values = [], []
    for name, given in hidden.items():
        effect = find_effect(name, among)
        known = [parameter.name for parameter in effect.parameters]
        for own in given:
            if own not in known:
                raise ValueError(f"effect {name!r} has no {own!r}; expected {', '.join(known)}")
        effects.append(effect)
        values += [float(given.get(p.name, p.null)) for p in effect.parameters]
    return Added(tuple(effects), torch.tensor([values], dtype=torch.float64))


class EffectTruth:
    """One outline in one scene with effects; keeps the rows so far.

    Readings of the wrench include what the effects do to the sensor. `steps` is the number of
    rows of the whole run, for effects that grow over it.
    """

    def __init__(
        self,
        outline_vertices_ee: Float[Tensor, "p 2"],
        friction: float,
        floor_height: float,
        wall_position: float,
        stiffness: Float[Tensor, " 3"],
        added: Added,
        steps: int,
        settings: StepSettings = TRUTH_SETTINGS,
    ) -> None:
        one = torch.ones(1, dtype=torch.float64)
        self._scene = ContactScene(
            points_ee=outline_vertices_ee.double()[None],
            terrains=(floor(floor_height * one), wall(wall_position * one)),
            friction=torch.full((1, 2), friction, dtype=torch.float64),
        )
        self._stiffness, self._added = stiffness.double(), added
        self._settings, self._steps = settings, steps
        self.reset(torch.zeros(3, dtype=torch.float64))

    def reset(self, pose: Float[Tensor, " 3"]) -> None:
        """Put the arm at rest at a pose [m, m, rad]."""
        self._poses = pose.double()[None]
        self._commands = self._poses

    def step(
        self, command: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"], bool]:
        """Move to a command; settled pose, wrench that is read and whether the arm settled."""
        self._commands = torch.cat((self._commands, command.double()[None]))
        # The last row's own pose is not known yet.
        poses = torch.cat((self._poses, self._poses[-1:]))
        rows = sequence(poses)
        rows = type(rows)(rows.follows, torch.arange(len(poses)) / self._steps, rows.starts)
        found = simulate_rows(
            self._scene,
            rows,
            self._commands,
            self._stiffness,
            self._added,
            self._settings,
            TRUE_PASSES if self._added.passes else 0,
        )
        pose = found.transition.pose[0, -1]
        # A floor that moves between two rows may reach above where the object was.
        settled = bool(found.transition.status[0, -1] <= int(StepStatus.START_INSIDE))
        self._poses = torch.cat((self._poses, pose[None]))
        return pose, found.wrench[0, -1], settled
