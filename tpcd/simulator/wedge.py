"""Rest poses between two rough terrains: what can slip is not held by a wedge.

Coulomb's law may allow both that an object in a corner slips and that it is held there, by forces
between the terrains that nothing has pressed it with (on straight terrains at right angles with
mu >= 1, and with less where the outline turns about its contacts). The fixed point of `settle`
starts without slip and may end in such a wedge, or creep into one. It is therefore sought from the
other end too, the pose without friction, and that with less load is taken. So are answers for what
is jammed, or did not converge, between two terrains. On steps in corners that is what MuJoCo does
when the arm moves slowly, and what terrains that yield by some micrometres do.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.loaded import put_contacts, take_contacts, terrain_load
from tpcd.simulator.record import StepSettings, StepStatus
from tpcd.simulator.settle import Settled, own, settle_from, without_friction

PATIENCE = 3
"""Times as many rounds from the pose without friction."""
LIGHTER = 0.999
"""Share of the load below which an answer has less."""


def settle(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "*each 3"],
    settings: StepSettings,
) -> Settled:
    """Rest pose and loaded contacts for each element; no gradient is recorded."""
    with torch.no_grad():
        settled = settle_from(scene, start, command, stiffness, settings)
        if settings.friction != "coulomb":
            return settled
        terrains = scene.friction.shape[-1]
        load = terrain_load(settled.contacts, terrains)
        between = (load > 0).sum(-1) > 1
        jammed = settled.status == int(StepStatus.RELAXED)
        index = torch.nonzero(between | jammed).flatten()
        if len(index) == 0:
            return settled
        part = scene.gather(index)
        arguments = (start[index], command[index], own(stiffness, index))
        free = settle_from(without_friction(part), *arguments, settings)
        patient = replace(settings, rounds=PATIENCE * settings.rounds)
        other = settle_from(part, *arguments, patient, free)
        lighter = terrain_load(other.contacts, terrains).sum(-1) < LIGHTER * load[index].sum(-1)
        failed = settled.status[index] != int(StepStatus.CONVERGED)
        better = (other.status == int(StepStatus.CONVERGED)) & (lighter | failed)
        taken = torch.nonzero(better).flatten()
        for name in ("pose", "status", "residual", "yielding"):
            getattr(settled, name)[index[taken]] = getattr(other, name)[taken]
        put_contacts(settled.contacts, index[taken], take_contacts(other.contacts, taken))
        return settled
