"""The quasi-static model f_theta(x, u): where the arm comes to rest, and with which wrench.

`simulate_step` answers a batch of (scene, start pose, command); `rollout` feeds it its own
poses. Gradients flow through every input when one of them asks for it. Without gradients
on a CPU where numba is installed, compiled loops do the same work.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.planar import wrap_angle
from tpcd.simulator import native
from tpcd.simulator.flight import FREE_GAP, Flight, first_touch, touch_row
from tpcd.simulator.implicit import linear_response, loaded_frames, newton_pose
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.record import ContactMode, ContactSet, StepSettings, StepStatus, Transition
from tpcd.simulator.settle import Settled, own, settle
from tpcd.terrain import HalfPlane

Engine = Literal["auto", "torch", "native"]
DEFAULT_SETTINGS = StepSettings()
GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


def simulate_step(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    command: Float[Tensor, "*#batch 3"],
    stiffness: Float[Tensor, "*#batch 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
    engine: Engine = "auto",
    previous: Float[Tensor, "*#batch 3"] | None = None,
) -> Transition:
    """Settle at `command` [m, m, rad] from the start pose `pose`.

    `previous` is the command at which the arm rested in the start pose. It tells what the
    object was pressed against, and where the command's path begins, on which friction
    depends; a measured start pose is first settled under it, which puts it back on the
    contact it had. Without it the arm is taken to rest without load, `previous = pose`.

    The batch axes of `scene`, `pose`, the commands and the stiffness are broadcast against each
    other. `stiffness` is the diagonal of K [N/m, N/m, N·m/rad]. Contact is solved in float64.
    Raises ValueError for a stiffness that is not positive.
    """
    if stiffness.shape[-1:] != (3,) or not bool((stiffness > 0).all()):
        raise ValueError(f"stiffness is {stiffness.tolist()}, expected three positive numbers")
    given = (pose, command, stiffness) if previous is None else (pose, command, stiffness, previous)
    batch = torch.broadcast_shapes(scene.batch_shape, *(one.shape[:-1] for one in given))
    if stiffness.ndim > 1:
        stiffness = stiffness.expand(*batch, 3).reshape(-1, 3)
    pose = pose.expand(*batch, 3).reshape(-1, 3)
    command = command.expand(*batch, 3).reshape(-1, 3)
    previous = None if previous is None else previous.expand(*batch, 3).reshape(-1, 3)
    owner = torch.arange(scene.batch_shape.numel(), device=pose.device)
    owner = owner.reshape(scene.batch_shape).expand(batch).reshape(-1)
    if _use_native(
        engine, scene, (pose, stiffness, command, *(() if previous is None else (previous,)))
    ):
        shared = stiffness.reshape(-1, 3)
        flat = native.step(scene, owner, pose, previous, command, shared, settings)
        _relax_jammed(flat, scene, owner, pose, previous, command, stiffness, settings)
    else:
        flat = _step_finite(
            scene.gather(owner).double(), pose.double(), previous, command, stiffness, settings
        )
    terrains = len(scene.terrains)
    return Transition(
        pose=flat.pose.reshape(*batch, 3),
        wrench=flat.wrench.reshape(*batch, 3),
        mode=flat.mode.reshape(*batch, terrains),
        status=flat.status.reshape(batch),
        residual=flat.residual.reshape(batch),
        pose_from_start=flat.pose_from_start.reshape(*batch, 3, 3),
        pose_from_gap=flat.pose_from_gap.reshape(*batch, terrains, 3),
        pose_from_lever=flat.pose_from_lever.reshape(*batch, terrains, 3),
        contacts=flat.contacts.reshape(*batch, terrains, 4),
    )


def rollout(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    commands: Float[Tensor, "n *#batch 3"],
    stiffness: Float[Tensor, " 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
    engine: Engine = "auto",
    previous: Float[Tensor, "*#batch 3"] | None = None,
) -> list[Transition]:
    """Run n commands in a row, each from the pose at which the one before came to rest."""
    transitions = []
    for command in commands:
        transition = simulate_step(
            scene, pose, command, stiffness, settings, engine, previous=previous
        )
        transitions.append(transition)
        pose, previous = transition.pose, command
    return transitions


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd is recording for any of the tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _use_native(engine: Engine, scene: ContactScene, given: tuple[Tensor, ...]) -> bool:
    bodies = [body for body in scene.terrains if isinstance(body, HalfPlane)]
    planes = [value for body in bodies for value in (body.direction, body.offset)]
    inputs = (scene.points_ee, scene.friction, *given, *planes)
    possible = (
        scene.friction.device.type == "cpu"
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
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> None:
    """Answer the elements that the compiled loops found jammed even without friction."""
    jammed = torch.nonzero(flat.status == native.JAMMED).flatten()
    if len(jammed) == 0:
        return
    before = None if previous is None else previous[jammed]
    part = _step(
        scene.gather(owner[jammed]),
        pose[jammed],
        before,
        command[jammed],
        own(stiffness, jammed),
        settings,
    )
    for name in vars(part):
        getattr(flat, name)[jammed] = getattr(part, name)


def _step_finite(
    scene: ContactScene,
    start: Tensor,
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> Transition:
    """Step what is finite and flag the rest, which then touches no gradient of the others."""
    given = [start, command, scene.friction, *([] if previous is None else [previous])]
    with torch.no_grad():
        gaps, _ = lowest_points(scene, start, start.new_zeros(*scene.friction.shape, 1))
        finite = torch.isfinite(gaps).flatten(1).all(-1)
        finite = finite & torch.isfinite(scene.points_ee).flatten(1).all(-1)
        for value in given:
            finite = finite & torch.isfinite(value).all(-1)
    if bool(finite.all()):
        return _step(scene, start, previous, command, stiffness, settings)
    index = torch.nonzero(finite).flatten()
    before = None if previous is None else previous[index]
    part = _step(
        scene.gather(index), start[index], before, command[index], own(stiffness, index), settings
    )
    blank = {"mode": int(ContactMode.FREE), "status": int(StepStatus.INVALID_INPUT)}
    whole = {}
    for name, value in vars(part).items():
        fill = blank.get(name, torch.inf if name == "residual" else torch.nan)
        empty = value.new_full((len(start), *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return Transition(**whole)


@dataclass(frozen=True)
class _State:
    """Where the object is after part of a step, with derivatives by the start of the step."""

    pose: Tensor
    from_start: Tensor
    from_gap: Tensor
    from_lever: Tensor
    contacts: Tensor
    mode: Tensor
    status: Tensor
    residual: Tensor

    def where(self, condition: Tensor, other: _State) -> _State:
        """This state where the condition holds, the other one elsewhere."""
        values = {}
        for name, value in vars(self).items():
            shape = (-1, *([1] * (value.ndim - 1)))
            values[name] = torch.where(condition.reshape(shape), value, getattr(other, name))
        return _State(**values)


def _step(
    scene: ContactScene,
    start: Tensor,
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> Transition:
    start, stiffness, scene = start.double(), stiffness.double(), scene.double()
    command = _unwrapped(command.double(), start)
    begin = _start_state(scene, start)
    rested = previous is None
    if rested:
        gaps, _ = lowest_points(scene, start, start.new_zeros(*scene.friction.shape, 1))
        touching = gaps[..., 0] <= FREE_GAP
        path_start = start
    else:
        path_start = _unwrapped(previous.double(), start)
        begin = _advance(scene, begin, path_start, 0.0, stiffness, settings)
        begin = replace(
            begin,
            status=torch.zeros_like(begin.status),
            residual=torch.zeros_like(begin.residual),
        )
        touching = begin.mode > 0
    # How much the command of a part moves with the start pose.
    follows = 1.0 if rested else 0.0
    end = _advance(scene, begin, command, 0.0, stiffness, settings)
    loaded = end.mode > 0
    changed = loaded.any(-1) & (loaded != touching).any(-1)
    winding = changed & (touching.any(-1) | (loaded.sum(-1) > 1))
    if settings.follow_path:
        winding = torch.ones_like(winding)
    index = torch.nonzero(winding).flatten()
    if settings.substeps > 1 and len(index) > 0:
        part_scene = scene.gather(index)
        state = _State(**{name: value[index] for name, value in vars(begin).items()})
        for k in range(1, settings.substeps + 1):
            share, target = k / settings.substeps, command[index]
            if k < settings.substeps:
                target = path_start[index] + share * (target - path_start[index])
            state = _advance(
                part_scene, state, target, follows * (1 - share), own(stiffness, index), settings
            )
        spread = torch.zeros_like(winding, dtype=torch.long)
        spread[index] = torch.arange(len(index), device=index.device)
        followed = _State(**{name: value[spread] for name, value in vars(state).items()})
        end = followed.where(winding, end)
    return Transition(
        pose=torch.cat((end.pose[:, :2], wrap_angle(end.pose[:, 2:])), dim=-1),
        wrench=stiffness * (end.pose - command),
        mode=end.mode,
        status=end.status,
        residual=end.residual,
        pose_from_start=end.from_start,
        pose_from_gap=end.from_gap,
        pose_from_lever=end.from_lever,
        contacts=end.contacts,
    )


def _unwrapped(command: Tensor, start: Tensor) -> Tensor:
    """The command with its angle turned by full turns to be the one nearest to the start's."""
    turn = start[:, 2:] + wrap_angle(command[:, 2:] - start[:, 2:])
    return torch.cat((command[:, :2], turn), dim=-1)


def _start_state(scene: ContactScene, start: Tensor) -> _State:
    count, terrains = scene.friction.shape
    zeros = start.new_zeros(count, terrains, 3)
    whole = torch.zeros(count, dtype=torch.long, device=start.device)
    return _State(
        pose=start,
        from_start=torch.eye(3).to(start).expand(count, 3, 3),
        from_gap=zeros,
        from_lever=zeros,
        contacts=start.new_zeros(count, terrains, 4),
        mode=torch.zeros(count, terrains, dtype=torch.long, device=start.device),
        status=whole,
        residual=start.new_zeros(count),
    )


def _advance(
    scene: ContactScene,
    state: _State,
    target: Tensor,
    follows: float,
    stiffness: Tensor,
    settings: StepSettings,
) -> _State:
    """Settle at one command of the path: free flight first, then contact."""
    flight = first_touch(scene, state.pose, target)
    landing, by_start, by_target, by_gap = _fly(scene, state.pose, target, flight)
    settled = settle(scene, landing, target, stiffness, settings)
    # What was answered without friction responds without it.
    relaxed = settled.status == int(StepStatus.RELAXED)
    if bool(relaxed.any()):
        friction = torch.where(relaxed[:, None], 0.0, scene.friction)
        scene = replace(scene, friction=friction)
    arguments = (scene, landing, target, stiffness, settled.pose, settled.contacts, settings)
    response = linear_response(*arguments)
    free, stands = flight.fraction >= 1, ~settled.yielding[:, None]
    landed_from_start = by_start @ state.from_start + follows * by_target
    landed_from_gap = by_gap + state.from_gap @ by_start.mT
    landed_from_lever = state.from_lever @ by_start.mT
    return _State(
        pose=torch.where(free[:, None], target, newton_pose(*arguments)).where(
            stands, settled.pose
        ),
        from_start=(response.start @ landed_from_start + follows * response.command).where(
            stands[..., None], 0.0
        ),
        from_gap=(response.gap + landed_from_gap @ response.start.mT).where(stands[..., None], 0.0),
        from_lever=(response.lever + landed_from_lever @ response.start.mT).where(
            stands[..., None], 0.0
        ),
        contacts=_contact_forces(scene, settled),
        mode=_contact_modes(settled, len(scene.terrains)),
        status=torch.maximum(state.status, settled.status),
        residual=torch.maximum(state.residual, settled.residual),
    )


def _fly(
    scene: ContactScene, start: Tensor, command: Tensor, flight: Flight
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pose at the first touch, and its derivatives by start pose, command and gaps."""
    way = command - start
    fraction = flight.fraction[:, None]
    flies = (flight.fraction > 0) & (flight.fraction < 1)
    touch = (start + fraction * way).detach()
    gap, row = touch_row(scene, start + fraction * way, flight)
    nearing = (row * way).detach()
    # A touch that grazes has no derivative; leave out how its time changes.
    flies = flies & (-nearing.sum(-1) > GRAZING * nearing.abs().sum(-1))
    approach = torch.where(flies, -nearing.sum(-1), 1.0)
    # One Newton step on gap(fraction) = 0 carries the derivatives of the touching time.
    correction = torch.where(flies, gap / approach, 0.0)[:, None]
    landing = torch.where(flies[:, None], start + (fraction + correction) * way, touch)
    landing = torch.where(flight.fraction[:, None] > 0, landing, start)
    landing = torch.where(flight.fraction[:, None] < 1, landing, command)
    with torch.no_grad():
        by_time = torch.where(flies, 1.0 / approach, 0.0)[:, None] * way
        identity = torch.eye(3, dtype=start.dtype, device=start.device)
        turn = identity + by_time[:, :, None] * torch.where(flies[:, None], row, 0.0)[:, None, :]
        terrains = torch.arange(len(scene.terrains), device=start.device)
        here = (terrains == flight.terrain[:, None]).to(start.dtype)
        by_gap = here[..., None] * by_time[:, None, :]
        share = fraction[..., None]
    return landing, (1 - share) * turn, share * turn, by_gap


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


def _contact_forces(scene: ContactScene, settled: Settled) -> Tensor:
    """Normal and tangential force, and the arm of the contact point, of each terrain."""
    contacts = settled.contacts
    frames = loaded_frames(scene, settled.pose, contacts)
    arm = (frames.points_world - settled.pose[:, None, :2]).detach()
    found = []
    for t in range(len(scene.terrains)):
        load = torch.where(contacts.terrain == t, contacts.multiplier, 0.0)
        normal = load.sum(-1)
        tangential = (load * contacts.side).sum(-1) * scene.friction[:, t].detach()
        share = load / torch.where(normal > 0, normal, 1.0)[:, None]
        place = (share[..., None] * arm).sum(1)
        found.append(torch.cat((normal[:, None], tangential[:, None], place), dim=-1))
    return torch.stack(found, dim=1)
