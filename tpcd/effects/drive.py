"""Effects on what the arm does: command, impedance, friction in its joints, external load."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows, angle_difference
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.protocol import EffectParameter


def _lag(conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None) -> Conditions:
    command = conditions.command
    missing = angle_difference(command, rows.before(command))
    return replace(conditions, command=command - column(values, 0)[..., None] * missing)


def _arm_friction(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    # The arm moves only once its spring pulls harder than the friction: a play operator
    # (Visintin, Differential Models of Hysteresis, 1994) on each axis.
    most = values[:, :1]
    command = conditions.command.expand(len(values), -1, -1)
    stiffness = conditions.stiffness[..., :2].expand(len(values), command.shape[1], 2)
    drive = stiffness * angle_difference(command, rows.before(command))[..., :2]
    held = [torch.zeros_like(drive[:, 0])]
    for k in range(1, command.shape[1]):
        before = int(rows.follows[k])
        start = held[before] if before < k else torch.zeros_like(held[0])
        held.append((start + drive[:, k]).clamp(-most, most))
    back = torch.stack(held, dim=1) / stiffness
    back = torch.cat((back, torch.zeros_like(back[..., :1])), dim=-1)
    return replace(conditions, command=conditions.command - back)


def _stiffness(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    ratio = torch.cat((values.exp(), torch.ones_like(values[:, :1])), dim=-1)
    return replace(conditions, stiffness=conditions.stiffness * ratio[:, None])


def _payload(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    weight, lever = column(values, 0), column(values, 1)
    down = 0.0 - weight
    torque = down * lever * conditions.command[..., 2].cos()
    force = down.expand_as(torque)
    wrench = torch.stack((torch.zeros_like(force), force, torque), dim=-1)
    return replace(conditions, load=conditions.load + wrench)


DRIVE_EFFECTS = (
    DeclaredEffect(
        "command_lag",
        "command",
        (EffectParameter("share", "1", 0.0, 0.5, shown_unit="%", shown_factor=100.0),),
        _lag,
        "the controller stays {0} of every step behind its command",
        needs=("free motion", "pause"),
    ),
    DeclaredEffect(
        "stiffness_error",
        "impedance",
        (
            EffectParameter("log_ratio_x", "1", -0.4, 0.4),
            EffectParameter("log_ratio_z", "1", -0.4, 0.4),
        ),
        _stiffness,
        "the stiffness differs from the stated one, by log ratios of {0} in x and {1} in z",
        needs=("floor load", "wall load"),
    ),  # fmt: skip
    DeclaredEffect(
        "arm_friction",
        "arm friction",
        (EffectParameter("force", "N", 0.0, 2.0),),
        _arm_friction,
        "friction in the arm holds back {0} on each axis",
        needs=("free motion",),
    ),
    DeclaredEffect(
        "payload",
        "external load",
        (
            EffectParameter("weight", "N", 0.0, 5.0),
            EffectParameter("lever", "m", -0.15, 0.15, shown_unit="mm", shown_factor=1e3),
        ),
        _payload,
        "a weight of {0} hangs on the arm, {1} from its origin",
        needs=("free motion",),
    ),
)
