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
from tpcd.contract import as_numbers, check_lengths, check_pose, check_stiffness, one_batch
from tpcd.parameters import LARGEST_FRICTION
from tpcd.simulator import native
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.path import follow_path
from tpcd.simulator.record import (
    ContactMode,
    StepSettings,
    StepStatus,
    Transition,
)
from tpcd.simulator.settle import own
from tpcd.terrain import OFF_UNIT, HalfPlane

Engine = Literal["auto", "torch", "native"]
DEFAULT_SETTINGS = StepSettings()


def simulate_step(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    command: Float[Tensor, "*#batch 3"],
    stiffness: Float[Tensor, "*#batch 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
    engine: Engine = "auto",
    previous: Float[Tensor, "*#batch 3"] | None = None,
    unusual: bool = False,
) -> Transition:
    """Settle at `command` [m, m, rad] from the start pose `pose`.

    `previous` is the command at which the arm rested in the start pose. It tells what the
    object was pressed against, and where the command's path begins, on which friction
    depends; a measured start pose is first settled under it, which puts it back on the
    contact it had. Without it the arm is taken to rest without load, `previous = pose`.

    The batch axes of `scene`, `pose`, the commands and the stiffness are broadcast against each
    other. `stiffness` is the diagonal of K [N/m, N/m, N·m/rad]. Contact is solved in float64.
    Arrays and lists are taken for tensors. Raises TypeError and ValueError for what has not three
    numbers, a stiffness that is not positive and finite and, unless `unusual`, for what looks like
    millimetres, degrees or N/mm (see `tpcd.contract`). Numbers that make no scene are a status.
    """
    if not isinstance(scene, ContactScene):
        raise TypeError(f"scene is a {type(scene).__name__}, expected a ContactScene")
    device = scene.friction.device
    pose = as_numbers("pose", pose, 3, device=device)
    command = as_numbers("command", command, 3, device=device)
    stiffness = as_numbers("stiffness", stiffness, 3, device=device)
    check_stiffness(stiffness, unusual)
    check_pose("pose", pose, unusual)
    check_pose("command", command, unusual)
    check_lengths("points_ee", scene.points_ee, unusual)
    if previous is not None:
        previous = as_numbers("previous", previous, 3, device=device)
        check_pose("previous", previous, unusual)
    given = (pose, command, stiffness) if previous is None else (pose, command, stiffness, previous)
    names = ("pose", "command", "stiffness", "previous")
    shapes = {name: one.shape[:-1] for name, one in zip(names, given, strict=False)}
    batch = one_batch({"scene": scene.batch_shape, **shapes})
    if stiffness.ndim > 1:
        stiffness = stiffness.expand(*batch, 3).reshape(-1, 3)
    pose = pose.expand(*batch, 3).reshape(-1, 3)
    command = command.expand(*batch, 3).reshape(-1, 3)
    previous = None if previous is None else previous.expand(*batch, 3).reshape(-1, 3)
    owner = torch.arange(scene.batch_shape.numel(), device=pose.device)
    owner = owner.reshape(scene.batch_shape).expand(batch).reshape(-1)
    given = (pose, stiffness, command, *(() if previous is None else (previous,)))
    compiled = _use_native(engine, scene, given)
    yields = scene.yields.reshape(-1)[owner]
    groups = [torch.nonzero(group).flatten() for group in (~yields, yields) if bool(group.any())]
    if len(groups) < 2:
        flat = _answer(compiled, scene, owner, pose, previous, command, stiffness, settings)
    else:
        # Rigid scenes apart from those that yield: no answer depends on what is beside it.
        parts = [
            _answer(
                compiled,
                scene,
                owner[index],
                pose[index],
                None if previous is None else previous[index],
                command[index],
                own(stiffness, index),
                settings,
            )
            for index in groups
        ]
        back = torch.cat(groups).argsort()
        both = zip(vars(parts[0]).items(), vars(parts[1]).values(), strict=True)
        flat = Transition(**{name: torch.cat((one, other))[back] for (name, one), other in both})
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
    unusual: bool = False,
) -> list[Transition]:
    """Run n commands in a row, each from the pose at which the one before came to rest.

    What is taken and raised is that of `simulate_step`.
    """
    transitions = []
    commands = as_numbers("commands", commands, 3)
    if commands.ndim < 2:
        raise ValueError(f"commands has shape {tuple(commands.shape)}, expected rows of 3 numbers")
    for command in commands:
        transition = simulate_step(
            scene, pose, command, stiffness, settings, engine, previous, unusual
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
    inputs = (scene.points_ee, scene.friction, scene.compliance, *given, *planes)
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


def _answer(
    compiled: bool,
    scene: ContactScene,
    owner: Tensor,
    pose: Tensor,
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
    settings: StepSettings,
) -> Transition:
    """Step transitions whose scenes are all rigid, or all yield."""
    if not compiled:
        return _step_finite(
            scene.gather(owner).double(), pose.double(), previous, command, stiffness, settings
        )
    shared = stiffness.reshape(-1, 3)
    flat = native.step(scene, owner, pose, previous, command, shared, settings)
    _relax_jammed(flat, scene, owner, pose, previous, command, stiffness, settings)
    return flat


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
    part = follow_path(
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
        finite = finite & ((scene.compliance >= 0) & (scene.compliance < torch.inf)).all(-1)
        for body in scene.terrains:
            if isinstance(body, HalfPlane):
                finite = finite & ((body.direction.square().sum(-1) - 1).abs() <= OFF_UNIT)
        finite = finite & ((scene.friction >= 0) & (scene.friction <= LARGEST_FRICTION)).all(-1)
    if bool(finite.all()):
        return follow_path(scene, start, previous, command, stiffness, settings)
    index = torch.nonzero(finite).flatten()
    before = None if previous is None else previous[index]
    part = follow_path(
        scene.gather(index), start[index], before, command[index], own(stiffness, index), settings
    )
    blank = {"mode": int(ContactMode.FREE), "status": int(StepStatus.INVALID_INPUT)}
    whole = {}
    for name, value in vars(part).items():
        fill = blank.get(name, torch.inf if name == "residual" else torch.nan)
        empty = value.new_full((len(start), *value.shape[1:]), fill)
        whole[name] = empty.index_copy(0, index, value)
    return Transition(**whole)
