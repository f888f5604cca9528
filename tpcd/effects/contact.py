"""Effects on the contact law: compliance, adhesion, and what friction depends on.

A floor or wall that yields along its normal is a part of the contact problem. Sideways, a grip
would yield by c F under the force F that it holds on rigid ground, but as it does the arm's spring
K eases, so that c F / (1 + c K) is where it ends. That is taken from the first pass; an error in a
later one falls to c K times that of the one before, so c K should be less than 1 where there are
later ones (K = 1000 N/m and 10 mm at 10 N make 1).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.effects.conditions import FLOOR, WALL, Conditions, Outcome, Rows, angle_difference
from tpcd.effects.declare import DeclaredEffect, column
from tpcd.effects.geometry import pose_change
from tpcd.effects.protocol import EffectParameter
from tpcd.simulator import ContactMode

REFERENCE_LOAD = 3.0
"""Load at which friction that depends on it has its nominal value [N]."""
_LOADS = (0.1, 30.0)


def _compliance(terrain: int):
    def change(
        conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
    ) -> Conditions:
        more = torch.zeros(len(values), 2, dtype=values.dtype)
        more[:, terrain] = values[:, 0]
        return replace(conditions, compliance=conditions.compliance + more[:, None])

    return change


def _tangential_compliance(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    give, softness = conditions.give, column(values, 0)
    for terrain in (FLOOR, WALL):
        normal, drag = conditions.normal[:, :, terrain], outcome.drag[:, :, terrain]
        tangent = torch.stack((normal[..., 1], -normal[..., 0]), dim=-1)
        # A grip on rigid ground holds with more; what slips, with what friction allows.
        sticks = outcome.first & (outcome.mode[:, :, terrain] == int(ContactMode.STICK))
        eased = torch.where(sticks, conditions.stiffness_along(tangent), 0.0)
        for _ in range(2):  # The row before has been eased too.
            way = softness * (rows.before(drag) - outcome.drag[:, :, terrain])
            way = way / (1.0 + softness * eased)
            way = torch.where(outcome.load[:, :, terrain] > 0, way, 0.0)
            drag = outcome.drag[:, :, terrain] + eased * way
        give = give + pose_change(tangent, way)
    return replace(conditions, give=give)


def _adhesion(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    force, pull = column(values, 0), conditions.pull
    way = angle_difference(outcome.pose, rows.before(outcome.pose))
    for terrain in (FLOOR, WALL):
        normal = conditions.normal[:, :, terrain]
        touches = outcome.load[:, :, terrain] > 0
        touched = rows.before(outcome.load)[:, :, terrain] > 0
        arm = torch.where(
            touches[..., None], outcome.arm[:, :, terrain], rows.before(outcome.arm)[:, :, terrain]
        )
        lever = arm[..., 0] * normal[..., 1] - arm[..., 1] * normal[..., 0]
        # What was touched comes off where the arm pulls harder than it sticks.
        gap = (normal * way[..., :2]).sum(-1) + lever * way[..., 2]
        mobility = (normal**2 / conditions.stiffness[..., :2]).sum(-1)
        mobility = mobility + lever**2 / conditions.stiffness[..., 2]
        holds = touches | (touched & (gap < force * mobility))
        size = torch.where(holds, 0.0 - force, 0.0)
        pull = pull + size[..., None] * torch.cat(
            (normal.expand(*size.shape, 2), lever[..., None]), dim=-1
        )
    return replace(conditions, pull=pull)


def _wall_friction(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    ratio = torch.ones(len(values), 2, dtype=values.dtype)
    ratio[:, WALL] = values[:, 0].exp()
    return replace(conditions, friction=conditions.friction * ratio[:, None])


def _directional(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    # Friction drags against the slip.
    ratio = (-outcome.drag.sign() * values[:, :1, None]).exp()
    return replace(conditions, friction=conditions.friction * ratio)


def _static_kinetic(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    # At first everything holds as well as it can; what slips all the same drops.
    ratio = values[:, :1, None]
    if outcome is not None:
        ratio = torch.where(outcome.mode > int(ContactMode.STICK), 1.0, ratio)
    return replace(conditions, friction=conditions.friction * ratio)


def _load_friction(
    conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Conditions:
    if outcome is None:
        return conditions
    relative = outcome.load.clamp(*_LOADS) / REFERENCE_LOAD
    ratio = torch.where(outcome.load > 0, relative ** values[:, :1, None], 1.0)
    return replace(conditions, friction=conditions.friction * ratio)


def _softness(most: float = 8e-4) -> EffectParameter:
    return EffectParameter(
        "compliance", "m/N", 0.0, most, shown_unit="mm per 10 N", shown_factor=1e4
    )


CONTACT_EFFECTS = (
    DeclaredEffect(
        "floor_compliance",
        "contact normal",
        (_softness(),),
        _compliance(FLOOR),
        "the floor yields {0}",
        needs=("floor loads",),
    ),
    DeclaredEffect(
        "wall_compliance",
        "contact normal",
        (_softness(),),
        _compliance(WALL),
        "the wall yields {0}",
        needs=("wall loads",),
    ),
    DeclaredEffect(
        "tangential_compliance",
        "contact tangent",
        (_softness(),),
        _tangential_compliance,
        "contacts that stick yield sideways by {0}",
        needs=("floor stick",),
        passes=1,
    ),
    DeclaredEffect(
        "adhesion",
        "contact normal",
        (EffectParameter("force", "N", 0.0, 5.0),),
        _adhesion,
        "surfaces hold the object with {0}",
        needs=("lift-off",),
        passes=1,
    ),
    DeclaredEffect(
        "wall_friction",
        "contact tangent",
        (EffectParameter("log_ratio", "1", -1.5, 1.5),),
        _wall_friction,
        "friction on the wall differs from that on the floor by a log ratio of {0}",
        needs=("floor slip", "wall slip"),
    ),
    DeclaredEffect(
        "directional_friction",
        "contact tangent",
        (EffectParameter("log_ratio", "1", -0.8, 0.8),),
        _directional,
        "friction depends on the direction of slip, by a log ratio of {0} either way",
        needs=("floor slip both ways",),
        passes=1,
    ),
    DeclaredEffect(
        "static_kinetic",
        "contact tangent",
        (EffectParameter("ratio", "1", 1.0, 2.0, null=1.0),),
        _static_kinetic,
        "friction before a slip is {0} times that during it",
        needs=("floor slip",),
        passes=1,
    ),
    DeclaredEffect(
        "load_friction",
        "contact tangent",
        (EffectParameter("exponent", "1", -0.8, 0.8),),
        _load_friction,
        "friction changes with load to the power of {0}",
        needs=("floor slip", "floor loads"),
        passes=1,
    ),
)
