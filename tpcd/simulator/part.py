"""One part of a command's path in torch, with derivatives: free flight, settling, and where contact
is expected to change passing on to there. `kernel_element` is the same in compiled loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.events import next_event
from tpcd.simulator.flight import Flight, first_touch, touch_row
from tpcd.simulator.implicit import LinearResponse, linear_response, loaded_frames, newton_step
from tpcd.simulator.loaded import slide
from tpcd.simulator.record import (
    REST_TOLERANCE,
    ContactMode,
    ContactSet,
    StepSettings,
    StepStatus,
)
from tpcd.simulator.rest import distance_from_rest
from tpcd.simulator.settle import Settled
from tpcd.simulator.wedge import settle

GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


@dataclass(frozen=True)
class State:
    """Where the object is after part of a step (pose (b, 3) [m, m, rad]), with its derivatives by
    the start of the step (b, 3, 3) and by gap [m] and lever [m] of each terrain (b, t, 3)."""

    pose: Tensor
    from_start: Tensor
    from_gap: Tensor
    from_lever: Tensor
    contacts: Tensor
    """Normal and tangential force [N] and arm of the contact point [m, m] of each terrain."""
    mode: Tensor
    slid: Tensor
    """Whether a loaded point moved along its terrain in the last part."""
    status: Tensor
    residual: Tensor
    ahead: Tensor
    """Share of the path until contact changes next; infinite if none is foreseen."""
    passes: Tensor
    """Whether the part passed on to that event after settling."""
    passed: Tensor
    """Share of the path that was passed on so."""

    def where(self, condition: Tensor, other: State) -> State:
        """This state where the condition holds, the other one elsewhere."""
        values = {}
        for name, value in vars(self).items():
            shape = (-1, *([1] * (value.ndim - 1)))
            values[name] = torch.where(condition.reshape(shape), value, getattr(other, name))
        return State(**values)

    def put(self, index: Tensor, other: State) -> State:
        """The other state at these elements, this one elsewhere."""
        values = {k: v.index_copy(0, index, getattr(other, k)) for k, v in vars(self).items()}
        return State(**values)


@dataclass(frozen=True)
class Part:
    """A part of a path from `path_start` to `command` (b, 3) [m, m, rad], up to a `share` (b).

    `rested` says that the path begins at the start pose, so that it moves with it. Where the next
    event lies within `room` (share of the path), the part passes on to it.
    """

    path_start: Tensor
    command: Tensor
    share: Tensor
    rested: bool
    room: Tensor

    @property
    def way(self) -> Tensor:
        """The path from its start to its end [m, m, rad]."""
        return self.command - self.path_start

    @property
    def target(self) -> Tensor:
        """The command at the end of the part."""
        share = self.share[:, None]
        return torch.where(share < 1, self.path_start + share * self.way, self.command)

    @property
    def follows(self) -> Tensor:
        """How much the target moves with the start pose (b, 1, 1)."""
        return ((1 - self.share) * self.rested)[:, None, None]


def whole(path_start: Tensor, command: Tensor, rested: bool) -> Part:
    """All of a path as one part."""
    share = torch.ones_like(command[:, 0])
    return Part(path_start, command, share, rested, torch.zeros_like(share))


def start_state(scene: ContactScene, start: Tensor) -> State:
    """The object at rest where it is, before anything was settled."""
    count, terrains = scene.friction.shape
    zeros = start.new_zeros(count, terrains, 3)
    none = torch.zeros(count, dtype=torch.long, device=start.device)
    return State(
        pose=start,
        from_start=torch.eye(3).to(start).expand(count, 3, 3),
        from_gap=zeros,
        from_lever=zeros,
        contacts=start.new_zeros(count, terrains, 4),
        mode=torch.zeros(count, terrains, dtype=torch.long, device=start.device),
        slid=none > 0,
        status=none,
        residual=start.new_zeros(count),
        ahead=start.new_full((count,), torch.inf),
        passes=none > 0,
        passed=start.new_zeros(count),
    )


def advance(
    scene: ContactScene,
    state: State,
    part: Part,
    stiffness: Tensor,
    settings: StepSettings,
) -> State:
    """Settle at the end of a part: free flight first, then contact."""
    target = part.target
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
    pose, multiplier = newton_step(*arguments)
    free, stands = flight.fraction >= 1, ~settled.yielding[:, None]
    pose = torch.where(free[:, None], target, pose).where(stands, settled.pose)
    held = replace(settled.contacts, multiplier=multiplier.detach().clamp_min(0.0))
    off = distance_from_rest(scene, pose, target, stiffness, held, settings)
    ends = (part.share == 1) & ~free
    unrest = ends & (off > REST_TOLERANCE * settings.tolerance)
    reached = torch.where(unrest, int(StepStatus.NOT_CONVERGED), int(StepStatus.CONVERGED))
    loose = free | settled.yielding
    pose, response, ahead, passes, passed = _pass_on(
        scene, part, pose, settled.contacts, multiplier, response, loose
    )
    landed_from_start = by_start @ state.from_start + part.follows * by_target
    landed_from_gap = by_gap + state.from_gap @ by_start.mT
    landed_from_lever = state.from_lever @ by_start.mT
    return State(
        pose=pose,
        from_start=(response.start @ landed_from_start + part.follows * response.command).where(
            stands[..., None], 0.0
        ),
        from_gap=(response.gap + landed_from_gap @ response.start.mT).where(stands[..., None], 0.0),
        from_lever=(response.lever + landed_from_lever @ response.start.mT).where(
            stands[..., None], 0.0
        ),
        contacts=_contact_forces(scene, settled),
        mode=_contact_modes(settled, len(scene.terrains)),
        slid=slide(scene, landing.detach(), settled.pose, settled.contacts, settings.tolerance),
        status=state.status.maximum(settled.status).maximum(reached),
        residual=state.residual.maximum(settled.residual).maximum(torch.where(ends, off, 0.0)),
        ahead=ahead,
        passes=passes,
        passed=passed,
    )


def _pass_on(
    scene: ContactScene,
    part: Part,
    pose: Tensor,
    contacts: ContactSet,
    multiplier: Tensor,
    response: LinearResponse,
    loose: Tensor,
) -> tuple[Tensor, LinearResponse, Tensor, Tensor, Tensor]:
    """Pose and response at the next event, where it lies within the room; at the end of the part
    elsewhere. Also how far ahead that event is, whether it was passed on to, and how far."""
    if bool((part.share == 1).all()):
        none = torch.zeros_like(part.share)
        return pose, response, none, none > 0, none
    event = next_event(scene, pose, contacts, multiplier, response, part.way.detach())
    ahead = torch.where(loose, torch.inf, event.ahead.detach())
    passes = ahead < part.room
    passed = torch.where(passes, event.ahead, 0.0)
    rate = torch.where(passes[:, None], event.rate, 0.0)
    response = replace(
        response,
        start=response.start + rate[:, :, None] * event.start[:, None, :],
        command=response.command + rate[:, :, None] * event.command[:, None, :],
        gap=response.gap + event.gap[:, :, None] * rate[:, None, :],
        lever=response.lever + event.lever[:, :, None] * rate[:, None, :],
    )
    return pose + rate * passed[:, None], response, ahead, passes, passed.detach()


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
