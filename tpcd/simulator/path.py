"""One step of a flat batch in torch, with derivatives: rest, flight, settling, and the command's
path where contact changes or turns. `kernel_element` is the same in compiled loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.planar import wrap_angle
from tpcd.simulator.flight import FREE_GAP, Flight, first_touch, touch_row
from tpcd.simulator.implicit import linear_response, loaded_frames, newton_pose
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.record import ContactMode, ContactSet, StepSettings, StepStatus, Transition
from tpcd.simulator.settle import Settled, own
from tpcd.simulator.walk import ALMOST, MOST_LOCATED, ends_alike, part_end, parts_of_path
from tpcd.simulator.wedge import settle

GRAZING = 1e-9
"""Share of the way's motion towards a terrain below which a touch only grazes it."""


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

    def put(self, index: Tensor, other: _State) -> _State:
        """The other state at these elements, this one elsewhere."""
        values = {k: v.index_copy(0, index, getattr(other, k)) for k, v in vars(self).items()}
        return _State(**values)


def follow_path(
    scene: ContactScene,
    start: Tensor,
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> Transition:
    """Step finite elements (b): rest on what was touched, go to the command, and in parts along its
    path where contact changes on the way or what is touched turns (see `walk`), unless the parts
    end worse than the whole."""
    start, stiffness, scene = start.double(), stiffness.double(), scene.double()
    command = _unwrapped(command.double(), start)
    begin = _start_state(scene, start)
    rested = previous is None
    if rested:
        gaps, _ = lowest_points(scene, start, start.new_zeros(*scene.friction.shape, 1))
        sticks = (gaps[..., 0] <= FREE_GAP).long() * int(ContactMode.STICK)
        begin, path_start = replace(begin, mode=sticks), start
    else:
        path_start = _unwrapped(previous.double(), start)
        begin = _advance(scene, begin, path_start, 0.0, stiffness, settings)
        begin = replace(
            begin,
            status=torch.zeros_like(begin.status),
            residual=torch.zeros_like(begin.residual),
        )
    end = _advance(scene, begin, command, 0.0, stiffness, settings)
    turn = (command - path_start)[:, 2].detach()
    parts = parts_of_path(settings, turn, begin.mode, end.mode)
    if bool((parts > 1).any()):
        walked = _walk(scene, begin, path_start, command, parts, rested, stiffness, settings)
        end = walked.where((parts > 1) & (walked.status <= end.status), end)
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


def _walk(
    scene: ContactScene,
    state: _State,
    path_start: Tensor,
    command: Tensor,
    parts: Tensor,
    rested: bool,
    stiffness: Tensor,
    settings: StepSettings,
) -> _State:
    """The end of the path in parts, for the elements that have more than one."""
    done = torch.where(parts > 1, 0.0, torch.ones_like(command[:, 0]))
    longest = 1.0 / parts.to(done)
    length, located = longest.clone(), torch.zeros_like(parts)
    while bool((done < 1).any()):
        index = torch.nonzero(done < 1).flatten()
        share = part_end(done[index], length[index], parts[index])
        reach = share[:, None]
        target = path_start[index] + reach * (command[index] - path_start[index])
        target = torch.where(reach < 1, target, command[index])
        here = _State(**{name: value[index] for name, value in vars(state).items()})
        # How much the command of a part moves with the start pose.
        follows = ((1 - reach) * rested)[..., None]
        there = _advance(
            scene.gather(index), here, target, follows, own(stiffness, index), settings
        )
        alike, gone = ends_alike(here.mode, there.mode), share - done[index]
        fits = alike | (gone <= settings.finest * (1 + ALMOST))
        fits = fits | (located[index] == MOST_LOCATED)
        located[index] += (fits & ~alike & (located[index] < MOST_LOCATED)).long()
        shorter = (0.5 * gone).clamp_min(settings.finest)
        length[index] = torch.where(fits, longest[index], shorter)
        done[index] = torch.where(fits, share, done[index])
        state = state.put(index, there.where(fits, here))
    return state


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
    follows: float | Tensor,
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
