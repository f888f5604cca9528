"""Derivatives of the settled pose by the implicit function theorem.

At rest the pose x' and the multipliers of the loaded contact rows solve

    K (x' - u) - B(x')^T lambda = 0,      c_j(x', start) = 0 for every loaded row j,

where B holds the force directions (n + s mu t) of the contacts as wrenches, and c_j is the
gap alone for a point that slips under Coulomb friction, or gap + s mu slip otherwise. One
Newton step on this system, taken at the solution with its matrix held fixed, changes no
value but carries exact first derivatives with respect to everything that enters the
residual: theta through the outline points, start, command and stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactFrame, ContactScene, contact_frame
from tpcd.planar import rotate
from tpcd.simulator.record import DEGREES, ContactSet, StepSettings

SINGULAR = 1e-9
"""Determinant over the product of the row sums below which loaded rows count as dependent."""
DEPENDENT = 1e-12
"""Pivot over the largest row sum below which they do where terrains yield: little compliance makes
rows nearly dependent."""


@dataclass(frozen=True)
class LinearResponse:
    """First-order change of the settled pose with start, command, gap and lever of each terrain,
    and that of the multipliers of the k rows in the same order."""

    start: Float[Tensor, "b 3 3"]
    command: Float[Tensor, "b 3 3"]
    gap: Float[Tensor, "b t 3"]
    lever: Float[Tensor, "b t 3"]
    load_start: Float[Tensor, "b k 3"]
    load_command: Float[Tensor, "b k 3"]
    load_gap: Float[Tensor, "b t k"]
    load_lever: Float[Tensor, "b t k"]


@dataclass(frozen=True)
class _System:
    """The equations at the solution: residuals, k rows, and their Schur complement."""

    force_residual: Tensor
    row_residual: Tensor
    constraint: Tensor
    force: Tensor
    inverse_stiffness: Tensor
    inverse_schur: Tensor
    loaded: Tensor
    start_row: Tensor


def newton_step(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "*each 3"],
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    settings: StepSettings,
) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b k"]]:
    """Pose and multipliers after one Newton step on the equations at rest."""
    system = _system(scene, start, command, stiffness, pose, contacts, settings)
    step, gain = _solve(system, -system.force_residual, -system.row_residual)
    return pose.detach() + step, contacts.multiplier + gain


def linear_response(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "*each 3"],
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    settings: StepSettings,
) -> LinearResponse:
    """Derivatives of the settled pose in closed form, for propagating noise."""
    with torch.no_grad():
        system = _system(scene, start, command, stiffness, pose, contacts, settings)
        zero_force = torch.zeros_like(system.force_residual)
        zero_row = torch.zeros_like(system.row_residual)
        start, command, gap, lever = [], [], [], []
        for axis in range(3):
            start.append(_solve(system, zero_force, -system.start_row[..., axis]))
            push = torch.zeros_like(zero_force)
            push[:, axis] = stiffness[..., axis]
            command.append(_solve(system, push, zero_row))
        for t in range(len(scene.terrains)):
            here = ((contacts.terrain == t) & system.loaded).to(pose.dtype)
            gap.append(_solve(system, zero_force, -here))
            moment = torch.zeros_like(zero_force)
            moment[:, 2] = (here * contacts.multiplier).sum(-1)
            lever.append(_solve(system, moment, zero_row))
        named = {}
        for name, columns, axis in (
            ("start", start, -1),
            ("command", command, -1),
            ("gap", gap, -2),
            ("lever", lever, -2),
        ):
            named[name] = torch.stack([motion for motion, _ in columns], dim=axis)
            named[f"load_{name}"] = torch.stack([load for _, load in columns], dim=axis)
        return LinearResponse(**named)


def _system(
    scene: ContactScene,
    start: Tensor,
    command: Tensor,
    stiffness: Tensor,
    pose: Tensor,
    contacts: ContactSet,
    settings: StepSettings,
) -> _System:
    pose, multiplier = pose.detach(), contacts.multiplier.detach()
    loaded = multiplier > 0
    now = loaded_frames(scene, pose, contacts)
    before = loaded_frames(scene, start, contacts)
    friction = torch.gather(scene.friction, -1, contacts.terrain)
    slope = contacts.side * friction
    slip = ((now.points_world - before.points_world) * now.tangent.detach()).sum(-1)
    force = now.normal_row + slope[..., None] * now.tangent_row
    held = ~contacts.slipping if settings.friction == "coulomb" else torch.ones_like(loaded)
    drag = torch.where(held, slope, 0.0)
    soft = torch.gather(scene.compliance, -1, contacts.terrain)
    soft = _same_terrain(contacts, loaded) * soft[..., None]
    row_residual = now.gap + drag * slip + (soft * multiplier[..., None, :]).sum(-1)
    force_residual = stiffness * (pose - command) - (multiplier[..., None] * force).sum(-2)
    constraint = (now.normal_row + drag[..., None] * now.tangent_row).detach()
    force = force.detach()
    inverse_stiffness = 1.0 / _effective_stiffness(scene, pose, stiffness, contacts, force)
    return _System(
        force_residual=force_residual,
        row_residual=torch.where(loaded, row_residual, 0.0),
        constraint=constraint,
        force=force,
        inverse_stiffness=inverse_stiffness,
        inverse_schur=_inverse_schur(constraint, force, inverse_stiffness, soft.detach(), loaded),
        loaded=loaded,
        start_row=-(drag[..., None] * before.tangent_row * loaded[..., None]).detach(),
    )


def _solve(system: _System, force: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Change of pose and multipliers for right-hand sides of the force balance and rows."""
    weighted = system.constraint * system.inverse_stiffness[..., None, :]
    right = torch.where(system.loaded, row - (weighted * force[..., None, :]).sum(-1), 0.0)
    multiplier = (system.inverse_schur * right[..., None, :]).sum(-1)
    push = force + (multiplier[..., None] * system.force).sum(-2)
    return system.inverse_stiffness * push, multiplier


def _inverse_schur(
    constraint: Tensor, force: Tensor, inverse_stiffness: Tensor, soft: Tensor, loaded: Tensor
) -> Tensor:
    """Inverse of the rows' Schur complement, zero where it is singular."""
    both = loaded[..., :, None] & loaded[..., None, :]
    weighted = constraint * inverse_stiffness[..., None, :]
    matrix = torch.where(
        both, (weighted[..., :, None, :] * force[..., None, :, :]).sum(-1) + soft, 0.0
    )
    matrix = matrix + torch.diag_embed((~loaded).to(matrix.dtype))
    if matrix.shape[-1] > DEGREES:
        factors, order, _ = torch.linalg.lu_factor_ex(matrix)
        pivot = factors.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
        regular = pivot > DEPENDENT * matrix.abs().sum(-1).amax(-1)
        whole = torch.eye(matrix.shape[-1]).to(matrix).expand_as(matrix)
        inverse = torch.linalg.lu_solve(factors, order, whole)
        return torch.where(regular[..., None, None], inverse, 0.0)
    first, second, third = matrix.unbind(-1)
    # Rows of the adjugate are the cross products of the columns.
    adjugate = torch.stack(
        (
            torch.linalg.cross(second, third),
            torch.linalg.cross(third, first),
            torch.linalg.cross(first, second),
        ),
        dim=-2,
    )
    determinant = (first * adjugate[..., 0, :]).sum(-1)
    regular = determinant.abs() > SINGULAR * matrix.abs().sum(-1).prod(-1)
    inverse = adjugate / torch.where(regular, determinant, 1.0)[..., None, None]
    return torch.where(regular[..., None, None], inverse, 0.0)


def _effective_stiffness(
    scene: ContactScene, pose: Tensor, stiffness: Tensor, contacts: ContactSet, force: Tensor
) -> Tensor:
    """Diagonal of K minus the turning of the contact forces' arms with the angle."""
    index = contacts.point[..., None].expand(*contacts.point.shape, 2)
    arm = rotate(pose[..., None, 2], torch.gather(scene.points_ee, -2, index))
    turning = (contacts.multiplier * (force[..., :2] * arm).sum(-1)).sum(-1)
    zero = torch.zeros_like(turning)
    return (stiffness + torch.stack((zero, zero, turning), dim=-1)).detach()


def loaded_frames(
    scene: ContactScene, pose: Float[Tensor, "b 3"], contacts: ContactSet
) -> ContactFrame:
    """Contact frames of the loaded rows, each against its own terrain."""
    frames = [contact_frame(scene.points_ee, body, pose, contacts.point) for body in scene.terrains]
    merged = {}
    for name in ("gap", "normal_row", "tangent_row", "points_world", "tangent"):
        value = getattr(frames[0], name)
        for t, frame in enumerate(frames[1:], start=1):
            here = contacts.terrain == t
            here = here if value.ndim == here.ndim else here[..., None]
            value = torch.where(here, getattr(frame, name), value)
        merged[name] = value
    return ContactFrame(**merged)


def _same_terrain(contacts: ContactSet, loaded: Tensor) -> Tensor:
    same = contacts.terrain[..., :, None] == contacts.terrain[..., None, :]
    return (same & loaded[..., :, None] & loaded[..., None, :]).to(contacts.multiplier.dtype)
