"""The quasi-static model f_theta(x, u): where the arm comes to rest, and with which wrench.

`simulate_step` answers a batch of (scene, start pose, command); `rollout` feeds it its own
poses. Gradients flow through every input when one of them asks for it. Without gradients
on a CPU where numba is installed, compiled loops do the same work.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.planar import wrap_angle
from tpcd.simulator import native
from tpcd.simulator.flight import Flight, first_touch, touch_row
from tpcd.simulator.implicit import linear_response, newton_pose
from tpcd.simulator.record import ContactMode, ContactSet, StepSettings, StepStatus, Transition
from tpcd.simulator.settle import Settled, settle
from tpcd.terrain import HalfPlane

Engine = Literal["auto", "torch", "native"]
DEFAULT_SETTINGS = StepSettings()


def simulate_step(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    command: Float[Tensor, "*#batch 3"],
    stiffness: Float[Tensor, " 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
    engine: Engine = "auto",
) -> Transition:
    """Settle at `command` [m, m, rad] from the start pose `pose`.

    The batch axes of `scene`, `pose` and `command` are broadcast against each other.
    `stiffness` is the diagonal of K [N/m, N/m, N·m/rad]. Contact is solved in float64.
    Raises ValueError for a stiffness that is not positive.
    """
    if stiffness.shape != (3,) or not bool((stiffness > 0).all()):
        raise ValueError(f"stiffness is {stiffness.tolist()}, expected three positive numbers")
    batch = torch.broadcast_shapes(scene.batch_shape, pose.shape[:-1], command.shape[:-1])
    pose = pose.expand(*batch, 3).reshape(-1, 3)
    command = command.expand(*batch, 3).reshape(-1, 3)
    owner = torch.arange(scene.batch_shape.numel(), device=pose.device)
    owner = owner.reshape(scene.batch_shape).expand(batch).reshape(-1)
    if _use_native(engine, scene, pose, command, stiffness):
        flat = native.step(scene, owner, pose, command, stiffness, settings)
        _relax_jammed(flat, scene, owner, pose, command, stiffness, settings)
    else:
        flat = _step(scene.gather(owner), pose, command, stiffness, settings)
    return Transition(
        pose=flat.pose.reshape(*batch, 3),
        wrench=flat.wrench.reshape(*batch, 3),
        mode=flat.mode.reshape(*batch, -1),
        status=flat.status.reshape(batch),
        residual=flat.residual.reshape(batch),
        pose_from_start=flat.pose_from_start.reshape(*batch, 3, 3),
        pose_from_gap=flat.pose_from_gap.reshape(*batch, -1, 3),
        pose_from_lever=flat.pose_from_lever.reshape(*batch, -1, 3),
    )


def rollout(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    commands: Float[Tensor, "n *#batch 3"],
    stiffness: Float[Tensor, " 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
    engine: Engine = "auto",
) -> list[Transition]:
    """Run n commands in a row, each from the pose at which the one before came to rest."""
    transitions = []
    for command in commands:
        transition = simulate_step(scene, pose, command, stiffness, settings, engine)
        transitions.append(transition)
        pose = transition.pose
    return transitions


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd is recording for any of the tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _use_native(
    engine: Engine, scene: ContactScene, pose: Tensor, command: Tensor, stiffness: Tensor
) -> bool:
    bodies = [body for body in scene.terrains if isinstance(body, HalfPlane)]
    planes = [value for body in bodies for value in (body.direction, body.offset)]
    inputs = (scene.points_ee, scene.friction, pose, command, stiffness, *planes)
    possible = (
        pose.device.type == "cpu"
        and len(bodies) == len(scene.terrains)
        and not needs_gradient(*inputs)
        and native.available()
    )
    if engine == "native" and not possible:
        raise ValueError(
            "engine 'native' needs numba, the CPU, half-plane terrains and no gradient; "
            "use engine 'torch' or 'auto'"
        )
    return possible and engine != "torch"


def _relax_jammed(
    flat: Transition,
    scene: ContactScene,
    owner: Tensor,
    pose: Tensor,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> None:
    """Answer the elements the compiled loops found jammed, without friction."""
    jammed = torch.nonzero(flat.status == int(StepStatus.RELAXED)).flatten()
    if len(jammed) == 0:
        return
    part = _step(scene.gather(owner[jammed]), pose[jammed], command[jammed], stiffness, settings)
    for name in vars(part):
        getattr(flat, name)[jammed] = getattr(part, name)


def _step(
    scene: ContactScene, start: Tensor, command: Tensor, stiffness: Tensor, settings: StepSettings
) -> Transition:
    start, command, stiffness = start.double(), command.double(), stiffness.double()
    scene = scene.double()
    # The arm turns the short way round.
    turn = start[:, 2:] + wrap_angle(command[:, 2:] - start[:, 2:])
    command = torch.cat((command[:, :2], turn), dim=-1)
    flight = first_touch(scene, start, command)
    landing, landing_from_start, landing_from_gap = _fly(scene, start, command, flight)
    pose, from_start, from_gap = landing, landing_from_start, landing_from_gap
    from_lever = torch.zeros_like(from_gap)
    status = torch.full_like(flight.point, int(StepStatus.CONVERGED))
    residual = torch.zeros_like(flight.fraction)
    settled = None
    for k in range(settings.substeps):
        share = (k + 1) / settings.substeps
        part = landing + (command - landing) * share
        settled = settle(scene, pose, part, stiffness, settings)
        arguments = (scene, pose, part, stiffness, settled.pose, settled.contacts, settings)
        response = linear_response(*arguments)
        from_start = (
            response.start @ from_start + (1 - share) * response.command @ landing_from_start
        )
        from_gap = (
            response.gap
            + from_gap @ response.start.mT
            + (1 - share) * landing_from_gap @ response.command.mT
        )
        from_lever = response.lever + from_lever @ response.start.mT
        pose = newton_pose(*arguments)
        status = torch.maximum(status, settled.status)
        residual = torch.maximum(residual, settled.residual)
    assert settled is not None
    return Transition(
        pose=torch.cat((pose[:, :2], wrap_angle(pose[:, 2:])), dim=-1),
        wrench=stiffness * (pose - command),
        mode=_contact_modes(settled, len(scene.terrains)),
        status=status,
        residual=residual,
        pose_from_start=from_start,
        pose_from_gap=from_gap,
        pose_from_lever=from_lever,
    )


def _fly(
    scene: ContactScene, start: Tensor, command: Tensor, flight: Flight
) -> tuple[Tensor, Tensor, Tensor]:
    """Pose at the first touch, and its derivatives by the start pose and the gaps."""
    way = command - start
    fraction = flight.fraction[:, None]
    flies = (flight.fraction > 0) & (flight.fraction < 1)
    touch = (start + fraction * way).detach()
    gap, row = touch_row(scene, start + fraction * way, flight)
    approach = torch.where(flies, -(row.detach() * way.detach()).sum(-1), 1.0)
    # One Newton step on gap(fraction) = 0 carries the derivatives of the touching time.
    correction = torch.where(flies, gap / approach, 0.0)[:, None]
    landing = torch.where(flies[:, None], start + (fraction + correction) * way, touch)
    landing = torch.where(flight.fraction[:, None] > 0, landing, start)
    landing = torch.where(flight.fraction[:, None] < 1, landing, command)
    with torch.no_grad():
        by_gap = torch.where(flies, 1.0 / approach, 0.0)[:, None] * way
        identity = torch.eye(3, dtype=start.dtype, device=start.device)
        from_start = (1 - fraction[..., None]) * (
            identity + by_gap[:, :, None] * torch.where(flies[:, None], row, 0.0)[:, None, :]
        )
        terrains = torch.arange(len(scene.terrains), device=start.device)
        here = (terrains == flight.terrain[:, None]).to(start.dtype)
        from_gap = here[..., None] * by_gap[:, None, :]
    return landing, from_start, from_gap


def _contact_modes(settled: Settled, terrains: int) -> Tensor:
    """`ContactMode` against each terrain, from the contact that carries the largest load."""
    contacts: ContactSet = settled.contacts
    modes = []
    for t in range(terrains):
        load = torch.where(contacts.terrain == t, contacts.multiplier, 0.0)
        largest, row = load.max(-1, keepdim=True)
        slipping = contacts.slipping.gather(1, row)
        # A loaded row of side +1 resists slip in the negative direction.
        positive = contacts.side.gather(1, row) < 0
        mode = torch.full_like(row, int(ContactMode.STICK))
        mode = torch.where(slipping & positive, int(ContactMode.SLIP_POSITIVE), mode)
        mode = torch.where(slipping & ~positive, int(ContactMode.SLIP_NEGATIVE), mode)
        modes.append(torch.where(largest > 0, mode, int(ContactMode.FREE)))
    return torch.cat(modes, dim=-1)
