"""One step of a flat batch in torch, with derivatives: rest, and the command's path at once, or in
parts where contact changes or turns. `kernel_element` is the same in compiled loops.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.planar import wrap_angle
from tpcd.simulator.flight import FREE_GAP
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.part import Part, State, advance, start_state, whole
from tpcd.simulator.record import (
    START_DEPTH,
    ContactMode,
    StepSettings,
    StepStatus,
    Transition,
)
from tpcd.simulator.rest import terrain_gaps_under
from tpcd.simulator.settle import own
from tpcd.simulator.walk import (
    AIM,
    ALMOST,
    GLANCE,
    LOOK,
    MOST_SOUGHT,
    PASSED,
    TRY,
    ends_alike,
    least_part,
    next_part,
    part_end,
    parts_of_path,
    shorter_part,
)


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
    begin = start_state(scene, start)
    rested = previous is None
    if rested:
        gaps, _ = lowest_points(scene, start, start.new_zeros(*scene.friction.shape, 1))
        sticks = (gaps[..., 0] <= FREE_GAP).long() * int(ContactMode.STICK)
        begin, path_start = replace(begin, mode=sticks), start
    else:
        path_start = _unwrapped(previous.double(), start)
        rest = whole(path_start, path_start, rested=False)
        begin = advance(scene, begin, rest, stiffness, settings)
        begin = replace(
            begin,
            status=torch.zeros_like(begin.status),
            residual=torch.zeros_like(begin.residual),
        )
    inside = -terrain_gaps_under(scene, start, begin.contacts[..., 0].detach()).amin(-1)
    at_once = whole(path_start, command, rested)
    end = advance(scene, begin, at_once, stiffness, settings)
    turn = (command - path_start)[:, 2].detach()
    parts = parts_of_path(settings, turn, begin.mode, end.mode, end.slid)
    if bool((parts > 1).any()):
        seeks = ~ends_alike(begin.mode, end.mode, end.slid)
        walked = _walk(scene, begin, path_start, command, parts, seeks, rested, stiffness, settings)
        end = walked.where((parts > 1) & (walked.status <= end.status), end)
    pushed = (inside > START_DEPTH) & (end.status == int(StepStatus.CONVERGED))
    return Transition(
        pose=torch.cat((end.pose[:, :2], wrap_angle(end.pose[:, 2:])), dim=-1),
        wrench=stiffness * (end.pose - command),
        mode=end.mode,
        status=torch.where(pushed, int(StepStatus.START_INSIDE), end.status),
        residual=end.residual,
        pose_from_start=end.from_start,
        pose_from_gap=end.from_gap,
        pose_from_lever=end.from_lever,
        contacts=end.contacts,
    )


def _walk(
    scene: ContactScene,
    state: State,
    path_start: Tensor,
    command: Tensor,
    parts: Tensor,
    seeks: Tensor,
    rested: bool,
    stiffness: Tensor,
    settings: StepSettings,
) -> State:
    """The end of the path in parts, for the elements that have more than one; where `seeks`,
    changes of contact are located from the start."""
    done = torch.where(parts > 1, 0.0, torch.ones_like(command[:, 0]))
    longest = 1.0 / parts.to(done)
    spent, moving = torch.zeros_like(parts), torch.zeros_like(seeks)
    seeks = seeks & (settings.finest < 1)
    kinds = torch.where(seeks, LOOK, TRY)
    length = torch.where(seeks, GLANCE, longest)
    while bool((done < 1).any()):
        index = torch.nonzero(done < 1).flatten()
        kind, before, every = kinds[index], done[index], parts[index]
        share = part_end(before, length[index], every)
        gone, left = share - before, part_end(before, longest[index], every) - share
        room = torch.where(kind == AIM, left.minimum(PASSED * gone), 0.0)
        part = Part(path_start[index], command[index], share, rested, room)
        here = State(**{name: value[index] for name, value in vars(state).items()})
        there = advance(scene.gather(index), here, part, own(stiffness, index), settings)
        idle = (spent[index] == MOST_SOUGHT) | (settings.finest == 1)
        fits = ends_alike(here.mode, there.mode, there.slid) | idle
        fits = fits | (gone <= least_part(kind, settings.finest) * (1 + ALMOST))
        spent[index] += (~idle & ((kind == AIM) | ~fits)).long()
        seeks[index] = (seeks[index] | ~fits) & (spent[index] < MOST_SOUGHT)
        reached = torch.where(fits, share + there.passed, before)
        left = part_end(reached, longest[index], every) - reached
        onward, straight = next_part(there.passes, seeks[index], there.ahead - there.passed, left)
        shorter, shortened = shorter_part(kind, moving[index], here.ahead, gone, settings.finest)
        kinds[index] = torch.where(fits, onward, shorter)
        length[index] = torch.where(fits, straight, shortened)
        moving[index] |= fits
        done[index] = reached
        state = state.put(index, there.where(fits, here))
    return state


def _unwrapped(command: Tensor, start: Tensor) -> Tensor:
    """The command with its angle turned by full turns to be the one nearest to the start's."""
    turn = start[:, 2:] + wrap_angle(command[:, 2:] - start[:, 2:])
    return torch.cat((command[:, :2], turn), dim=-1)
