"""One quasi-static substep for a flat batch: find the pose at which the arm comes to rest.

The pose x' minimises 1/2 (x' - u)^T K (x' - u) subject to, for every outline point i, every
terrain and both sides s = +1, -1,

    gap_i(x') + s mu slip_i(x') + mu sigma_i + y >= 0,

slip being the tangential motion of the point since the start of the substep. With
sigma = 0 this is the convex friction of Anitescu (2006); sigma = |slip|, found as a fixed
point, is Coulomb friction (De Saxce and Feng 1998). y is how far that terrain yields, c times the
load on it: with a compliance c it is one more variable, which costs y^2 / 2c. Then floor and wall
share the load of what both hold, which friction alone leaves open. Each round re-linearises
everything at the last solution, so the answer holds for the turned outline and not only for its
first linearisation.

With mu >= 1 an object that starts in penetration between two terrains can be jammed: no
motion satisfies its rows. It is answered without friction, which is always possible and
pushes it out the shortest way, and flagged RELAXED. `wedge` looks for better answers there.
These files work on tensors of any device; `native` is the same in compiled loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.contact import ContactScene, contact_frame
from tpcd.qp import ContactQP, Status, solve
from tpcd.simulator.implicit import newton_step
from tpcd.simulator.loaded import (
    no_contacts,
    put_contacts,
    take_contacts,
    with_slip,
)
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.record import DEGREES, ContactSet, StepSettings, StepStatus

PROBE_ANGLE = 0.02
"""Rotation [rad] whose lowest points are candidates too, so that a flat face shows both ends."""
NEWTON_ROUNDS = 6
"""Rounds in which a Newton step on Coulomb's law is tried; later ones are plain fixed point."""


@dataclass(frozen=True)
class Settled:
    """Result of one substep on a flat batch of b elements."""

    pose: Float[Tensor, "b 3"]
    contacts: ContactSet
    status: Int[Tensor, " b"]
    residual: Float[Tensor, " b"]
    yielding: Bool[Tensor, " b"]
    """Jammed even without friction: the pose yields a little to every terrain and has no
    derivative."""


@dataclass(frozen=True)
class _Rows:
    """Constraint rows of all candidates, r = terrains x slots x two sides."""

    jacobian: Tensor
    offset: Tensor
    point: Tensor
    terrain: Tensor
    side: Tensor


def settle_from(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "*each 3"],
    settings: StepSettings,
    sought: Settled | None = None,
) -> Settled:
    """The rest pose and loaded contacts that are found from `sought`, or from the start."""
    count, terrains = scene.friction.shape
    device = start.device
    pose = (start if sought is None else sought.pose).clone()
    residual = torch.full_like(start[:, 0], torch.inf)
    status = torch.full((count,), int(StepStatus.NOT_CONVERGED), device=device)
    rows = DEGREES + (terrains if bool(scene.yields.any()) else 0)
    contacts = no_contacts(count, rows, start) if sought is None else sought.contacts
    extent = scene.points_ee.norm(dim=-1).amax(-1)
    # What a point slips in a round, Coulomb friction may lift it in the next one.
    rough = scene.friction.amax(-1).clamp_min(1.0) if settings.friction == "coulomb" else 1.0
    still = settings.tolerance / rough * torch.ones_like(extent)
    running = torch.arange(count, device=device)
    part = scene
    for k in range(settings.rounds):
        if len(running) == 0:
            break
        loaded = take_contacts(contacts, running)
        candidates = _candidate_rows(part, start[running], pose[running], loaded, settings)
        step, found, relaxed = _solve_rows(
            part, candidates, command[running] - pose[running], own(stiffness, running), rows
        )
        after = pose[running] + step
        found = with_slip(part, start[running], after, found, settings.tolerance)
        put_contacts(contacts, running, found)
        change = _motion(step, extent[running])
        residual[running] = change
        settled = (change <= still[running]) & ~relaxed
        if k < NEWTON_ROUNDS:
            polished, _ = newton_step(
                part,
                start[running],
                command[running],
                own(stiffness, running),
                after,
                found,
                settings,
            )
            # A step beyond what this round moved comes from a wrong guess of the contacts.
            small = _motion(polished - after, extent[running]) <= 2 * change
            trusted = ~settled & ~relaxed & small
            after = torch.where(trusted[:, None], polished, after)
        pose[running] = after
        status[running] = torch.where(
            relaxed,
            int(StepStatus.RELAXED),
            torch.where(settled, int(StepStatus.CONVERGED), int(StepStatus.NOT_CONVERGED)),
        )
        kept = torch.nonzero(~settled & ~relaxed).flatten()
        if len(kept) < len(running):
            running, part = running[kept], part.gather(kept)
    jammed = torch.nonzero(status == int(StepStatus.RELAXED)).flatten()
    yielding = torch.zeros_like(status, dtype=torch.bool)
    if len(jammed) > 0 and bool((scene.friction[jammed] != 0).any()):
        part = without_friction(scene.gather(jammed))
        own_stiffness = own(stiffness, jammed)
        free = settle_from(part, start[jammed], command[jammed], own_stiffness, settings)
        pose[jammed], residual[jammed] = free.pose, free.residual
        yielding[jammed] = free.yielding
        put_contacts(contacts, jammed, free.contacts)
    elif len(jammed) > 0:
        # Terrains that face each other jam without friction too.
        yielding[jammed] = True
    return Settled(pose, contacts, status, residual, yielding)


def own(stiffness: Float[Tensor, "*each 3"], index: Tensor) -> Tensor:
    """The stiffness of some elements: shared by all, or one for each."""
    return stiffness if stiffness.ndim == 1 else stiffness[index]


def without_friction(scene: ContactScene) -> ContactScene:
    """The same scene on smooth terrains."""
    return replace(scene, friction=torch.zeros_like(scene.friction))


def _candidate_rows(
    scene: ContactScene,
    start: Tensor,
    pose: Tensor,
    loaded: ContactSet,
    settings: StepSettings,
) -> _Rows:
    """Linearise gap and slip at `pose` for the points that could carry load."""
    candidates = _candidates(scene, start, pose, loaded, settings)
    parts = []
    for t, body in enumerate(scene.terrains):
        index = candidates[:, t]
        now = contact_frame(scene.points_ee, body, pose, index)
        before = contact_frame(scene.points_ee, body, start, index)
        friction = scene.friction[:, t, None]
        slip = ((now.points_world - before.points_world) * now.tangent).sum(-1)
        lift = friction * slip.abs() if settings.friction == "coulomb" else 0.0
        for side in (1.0, -1.0):
            parts.append(
                _Rows(
                    jacobian=now.normal_row + side * friction[..., None] * now.tangent_row,
                    offset=now.gap + side * friction * slip + lift,
                    point=index,
                    terrain=torch.full_like(index, t),
                    side=torch.full_like(slip, side),
                )
            )
    names = ("jacobian", "offset", "point", "terrain", "side")
    return _Rows(**{name: torch.cat([getattr(p, name) for p in parts], dim=1) for name in names})


def _candidates(
    scene: ContactScene, start: Tensor, pose: Tensor, loaded: ContactSet, settings: StepSettings
) -> Tensor:
    """Indices (b, t, slots) of the points that touch first as the object sinks, turns or slips."""
    zero = torch.zeros_like(scene.friction)
    turned = torch.full_like(zero, PROBE_ANGLE)
    _, index = lowest_points(scene, pose, torch.stack((zero, turned, -turned), dim=-1))
    parts = [index]
    if settings.friction == "anitescu":
        # A row asks for gap + s mu slip, which need not be least where the gap is.
        sides = torch.stack((scene.friction, -scene.friction), dim=-1)
        parts.append(lowest_points(scene, pose, sides, start)[1])
    terrains = torch.arange(index.shape[1], device=index.device)[:, None]
    here = (loaded.terrain[:, None] == terrains) & (loaded.multiplier > 0)[:, None]
    parts.append(torch.where(here, loaded.point[:, None], index[..., :1]))
    return torch.cat(parts, dim=-1)


def _solve_rows(
    scene: ContactScene, rows: _Rows, target: Tensor, stiffness: Tensor, most: int
) -> tuple[Tensor, ContactSet, Tensor]:
    """Motion to the minimum, up to `most` rows loaded there, and which elements were relaxed."""
    jacobian, hessian, terrains = rows.jacobian, stiffness, scene.friction.shape[-1]
    if most > DEGREES:
        # How far each terrain yields, in units in which its spring costs half of their square.
        own_terrain = rows.terrain[..., None] == torch.arange(terrains, device=target.device)
        root = scene.compliance.sqrt()[:, None, :]
        jacobian = torch.cat((jacobian, torch.where(own_terrain, root, 0.0)), dim=-1)
        hessian = torch.cat((hessian.expand_as(target), torch.ones_like(scene.friction)), dim=-1)
        target = torch.cat((target, torch.zeros_like(scene.friction)), dim=-1)
    solution = solve(
        ContactQP(
            hessian=torch.diag_embed(hessian),
            target=target,
            rows=jacobian,
            offsets=rows.offset,
        )
    )
    multiplier, order = torch.topk(solution.multipliers, most, dim=-1)
    contacts = ContactSet(
        multiplier=multiplier,
        point=rows.point.gather(1, order),
        terrain=rows.terrain.gather(1, order),
        side=rows.side.gather(1, order),
        slipping=torch.zeros_like(order, dtype=torch.bool),
    )
    motion = solution.motion[:, :DEGREES]
    return motion, contacts, solution.status == int(Status.RELAXED)


def _motion(step: Tensor, extent: Tensor) -> Tensor:
    """Largest motion of any point of the object under a small pose change [m]."""
    return step[:, :2].abs().amax(-1) + step[:, 2].abs() * extent
