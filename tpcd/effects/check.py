"""A look at an effect before it is used: does it do what effects promise?

It is applied to a few made-up particles and rows, before and after a first outcome. At the
null values of its parameters nothing may change, not by one bit; and what it makes of one
particle may not depend on the others. What it needs are excitations that a diagnosis knows.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows, bare_conditions, sequence
from tpcd.effects.excitations import NEEDED
from tpcd.effects.guard import FIELDS
from tpcd.effects.protocol import Added, Effect, EffectParameter, parameter_bounds
from tpcd.errors import EffectError
from tpcd.simulator import ContactMode

_PARTICLES, _ROWS = 3, 4


def check_effect(effect: Effect) -> None:
    """Raise `EffectError` with the first promise that an effect breaks."""
    for parameter in effect.parameters:
        if not isinstance(parameter, EffectParameter):
            raise EffectError(effect.name, f"has the parameter {parameter!r}, no EffectParameter")
        if not parameter.low <= parameter.null <= parameter.high:
            raise EffectError(
                effect.name,
                f"has null value {parameter.null} of {parameter.name!r} outside of its range"
                f" [{parameter.low}, {parameter.high}]",
            )
    unknown = [need for need in effect.needs if need not in NEEDED]
    if unknown:
        known = ", ".join(NEEDED)
        raise EffectError(effect.name, f"needs {unknown[0]!r}, expected any of {known}")
    rows, conditions, outcome = _made_up()
    null = torch.tensor([p.null for p in effect.parameters], dtype=torch.float64)
    low, high = parameter_bounds([effect])
    share = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)[:, None]
    values = low + share * (high - low)
    for seen in (None, outcome, replace(outcome, first=~outcome.first)):
        name = _differing(conditions, _apply(effect, null.expand(_PARTICLES, -1), rows, seen))
        if name:
            raise EffectError(
                effect.name, f"changes {name} at the null values of its parameters, expected no bit"
            )
        together = _apply(effect, values, rows, seen)
        own = None if seen is None else seen[:1]
        alone = _apply(effect, values[:1], rows, own)
        first = Conditions(**{n: v[:1] for n, v in vars(together).items()})
        name = _differing(alone, first)
        if name:
            raise EffectError(
                effect.name, f"mixes particles: {name} of the first depends on the others"
            )
    found = [_apply(effect, values, rows, seen) for seen in (None, outcome)]
    if effect.passes < 1 and _differing(*found):
        raise EffectError(effect.name, "answers to the outcome, so expected 'passes' of 1 or more")
    try:
        effect.sentence(["1"] * len(effect.parameters))
    except Exception as error:
        raise EffectError(effect.name, f"has no sentence ({error})") from error


def _apply(effect: Effect, values: Tensor, rows: Rows, outcome: Outcome | None) -> Conditions:
    return Added((effect,), values).apply(_made_up()[1], rows, outcome)


def _differing(before: Conditions, after: Conditions) -> str:
    """The first field whose bits differ; empty if none does."""
    for name in FIELDS:
        old, new = torch.broadcast_tensors(getattr(before, name), getattr(after, name))
        if not bool((old == new).logical_or(old.isnan() & new.isnan()).all()):
            return name
    return ""


def _made_up() -> tuple[Rows, Conditions, Outcome]:
    """Free, pressed on the floor, slid along it, pressed against the wall."""
    commands = torch.tensor(
        [[0.0, 0.02, 0.0], [0.0, -0.03, 0.05], [0.04, -0.03, 0.0], [0.08, 0.01, -0.05]],
        dtype=torch.float64,
    )
    poses = commands.clone()
    poses[1:3, 1] = 0.0
    poses[3, 0] = 0.06
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    bare = bare_conditions(commands, stiffness)
    # Nothing is zero that an effect could multiply.
    conditions = replace(
        bare,
        friction=bare.friction + 0.4,
        offset=bare.offset + 0.05,
        compliance=bare.compliance + 1e-4,
        **{name: getattr(bare, name) + 1e-3 for name in ("load", "pull", "turn", "give", "bias")},
    )
    load = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    stick, slip = int(ContactMode.STICK), int(ContactMode.SLIP_POSITIVE)
    mode = torch.tensor([[0, 0], [stick, 0], [slip, 0], [0, stick]])
    arm = torch.zeros(_ROWS, 2, 2, dtype=torch.float64)
    arm[:, 0, 1], arm[:, 1, 0] = -0.05, 0.05
    arm = arm * (load > 0)[..., None]
    outline = torch.tensor([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]).double()
    contacts = torch.cat((load[..., None], -0.4 * load[..., None], arm), dim=-1)
    parts = (poses, mode, contacts, outline)
    settled = (part.expand(_PARTICLES, *part.shape).clone() for part in parts)
    outcome = Outcome.of(*settled, first=True)
    return sequence(poses), conditions, outcome
