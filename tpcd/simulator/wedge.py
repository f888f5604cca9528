"""Rest poses between two rough terrains: what can slip is not held by a wedge.

Coulomb's law may allow both that an object in a corner slips and that it is held there, by forces
between the terrains that nothing has pressed it with (on straight terrains at right angles with
mu >= 1, and with less where the outline turns about its contacts). The fixed point of `settle`
starts without slip and may end in such a wedge, or creep into one. It is therefore sought from the
other end too, the pose without friction, and that with less load is taken. So are answers for what
is jammed, or did not converge, between two terrains. On steps in corners that is what MuJoCo does
when the arm moves slowly, and what terrains that yield by some micrometres do.

Most rest in one way whatever is asked of them, and are spared the search. Each of the two contacts
is free, sticks, or slips either way, and in each of these cases loads and motion are linear in the
command. They follow from it in one way if the determinants of all cases have the same sign (for
problems of complementarity these are the P-matrices of Samelson, Thrall and Wesler, "A partition
theorem for Euclidean n-space", 1958; for friction see Klarbring, "Examples of non-uniqueness and
non-existence of solutions to quasistatic contact problems with friction", 1990). Without friction
they are positive. They stay so while what friction adds is less than what was there.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.implicit import loaded_frames
from tpcd.simulator.loaded import put_contacts, take_contacts, terrain_load
from tpcd.simulator.record import ContactSet, StepSettings, StepStatus
from tpcd.simulator.settle import Settled, own, settle_from, without_friction

PATIENCE = 3
"""Times as many rounds from the pose without friction."""
LIGHTER = 0.999
"""Share of the load below which an answer has less."""
SINGLE = 0.95
"""Share of what was there that friction may add where an object surely rests in one way: contacts
are not quite where they would be elsewhere. Of steps in corners that had another answer with less
load, none had less than 1."""


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
        sought = settled.status == int(StepStatus.RELAXED)
        sought |= between & (settled.status == int(StepStatus.NOT_CONVERGED))
        index = torch.nonzero(between & ~sought).flatten()
        contacts = take_contacts(settled.contacts, index)
        held = (scene.gather(index), settled.pose[index], contacts, own(stiffness, index))
        sought[index] = ~rests_one_way(*held)
        index = torch.nonzero(sought).flatten()
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


def rests_one_way(
    scene: ContactScene,
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    stiffness: Float[Tensor, "*each 3"],
) -> Bool[Tensor, " b"]:
    """Whether what one point each of two terrains holds surely rests in one way, at settled poses
    [m, m, rad] of an arm with the diagonal of `stiffness` [N/m, N/m, N·m/rad]."""
    loaded = contacts.multiplier > 0
    first = loaded.long().argmax(-1, keepdim=True)
    beside = loaded & (contacts.terrain != contacts.terrain.gather(1, first))
    second = beside.long().argmax(-1, keepdim=True)
    alone = torch.ones_like(loaded)
    for row, group in ((first, loaded & ~beside), (second, beside)):
        same = (contacts.point == contacts.point.gather(1, row)) & (
            contacts.terrain == contacts.terrain.gather(1, row)
        )
        alone &= ~group | same
    frames = loaded_frames(scene, pose, contacts)
    rows = []
    for row in (first, second):
        index = row[..., None].expand(-1, 1, 3)
        rows.append(
            (frames.normal_row.gather(1, index)[:, 0], frames.tangent_row.gather(1, index)[:, 0])
        )
    (normal_a, along_a), (normal_b, along_b) = rows

    def product(one: Tensor, other: Tensor) -> Tensor:
        return (one * other / stiffness).sum(-1)

    terrain = torch.cat([contacts.terrain.gather(1, row) for row in (first, second)], dim=-1)
    rough_a, rough_b = scene.friction.gather(1, terrain).unbind(-1)
    soft_a, soft_b = scene.compliance.gather(1, terrain).unbind(-1)
    give_a, give_b = product(normal_a, normal_a) + soft_a, product(normal_b, normal_b) + soft_b
    drag_a, drag_b = product(normal_a, along_a), product(normal_b, along_b)
    both, by_a, by_b = (
        product(normal_a, normal_b),
        product(normal_b, along_a),
        product(normal_a, along_b),
    )
    sure = alone.all(-1)
    sure &= (rough_a * drag_a.abs() < SINGLE * give_a) & (rough_b * drag_b.abs() < SINGLE * give_b)
    for slip_a in (rough_a, -rough_a):
        for slip_b in (rough_b, -rough_b):
            crossed = (both + slip_a * by_a) * (both + slip_b * by_b)
            sure &= crossed < SINGLE * (give_a + slip_a * drag_a) * (give_b + slip_b * drag_b)
    across = product(along_a, along_b)
    for rough, held, other, by_held, by_other in (
        (rough_b, (give_a, drag_a, product(along_a, along_a)), (give_b, drag_b), by_a, by_b),
        (rough_a, (give_b, drag_b, product(along_b, along_b)), (give_a, drag_a), by_b, by_a),
    ):
        # One slips while the other one sticks: its numbers without what both share.
        give, drag, along = held
        size = give * along - drag**2
        normal = (along * both - drag * by_held) / size
        tangent = (give * by_held - drag * both) / size
        left = other[0] - both * normal - by_held * tangent
        more = other[1] - by_other * normal - across * tangent
        sure &= rough * more.abs() < SINGLE * left
    return sure
