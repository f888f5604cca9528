"""The quasi-static model f_theta(x, u): where the arm comes to rest, and with which wrench.

`simulate_step` answers a batch of (scene, start pose, command); `rollout` feeds it its own poses.
Compiled loops make the step and, where one is asked for, its exact derivatives by every input:
the answer is the same with and without. They run on the CPU, in float64.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.contract import as_numbers, check_lengths, check_pose, check_stiffness, one_batch
from tpcd.planar import wrap_angle
from tpcd.simulator.engine import Answered, Asked, step
from tpcd.simulator.record import StepSettings, StepStatus, Transition

DEFAULT_SETTINGS = StepSettings()


def simulate_step(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    command: Float[Tensor, "*#batch 3"],
    stiffness: Float[Tensor, "*#batch 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
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
    Pose and wrench are differentiable once, by every floating input; at a change of contact the
    derivative is that of the side on which the answer lies, of a touch that only grazes it leaves
    out how its time changes, and where the object is jammed even without friction it is 0. A
    terrain's direction counts by its angle. Of tensors on another device the step is made on the
    CPU.

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
    asked = _flat(scene, batch, pose, previous, command, stiffness)
    if any(asked.reliefs) and settings.friction == "anitescu":
        raise ValueError("convex friction knows planes only; take friction 'coulomb' on a relief")
    yields = scene.yields.reshape(-1)[asked.scene.to(device)].cpu()
    groups = [torch.nonzero(group).flatten() for group in (~yields, yields) if bool(group.any())]
    if len(groups) < 2:
        found = _settle(asked, settings, device)
    else:
        # Rigid scenes apart from those that yield: no answer depends on what is beside it.
        parts = [_settle(_part(asked, index), settings, device) for index in groups]
        back = torch.cat(groups).argsort()
        found = Answered(*(torch.cat(both)[back] for both in zip(*parts, strict=True)))
    turn = asked.start[:, 2] + wrap_angle(asked.command[:, 2] - asked.start[:, 2])
    away = found.pose - torch.cat((asked.command[:, :2], turn[:, None]), dim=-1)
    wrench = asked.stiffness * away
    invalid = (found.status == int(StepStatus.INVALID_INPUT))[:, None]
    if bool(invalid.any()):
        # What has no answer touches no gradient of the others, with which it shares inputs.
        wrench = (asked.stiffness * away.masked_fill(invalid, 0.0)).masked_fill(invalid, torch.nan)
    terrains = len(scene.terrains)
    values = {
        "pose": (torch.cat((found.pose[:, :2], wrap_angle(found.pose[:, 2:])), dim=-1), (3,)),
        "wrench": (wrench, (3,)),
        "mode": (found.mode, (terrains,)),
        "status": (found.status, ()),
        "residual": (found.residual, ()),
        "pose_from_start": (found.from_start, (3, 3)),
        "pose_from_gap": (found.from_gap, (terrains, 3)),
        "pose_from_lever": (found.from_lever, (terrains, 3)),
        "contacts": (found.contacts, (terrains, 4)),
    }
    return Transition(
        **{name: one.reshape((*batch, *axes)).to(device) for name, (one, axes) in values.items()}
    )


def rollout(
    scene: ContactScene,
    pose: Float[Tensor, "*batch 3"],
    commands: Float[Tensor, "n *#batch 3"],
    stiffness: Float[Tensor, " 3"],
    settings: StepSettings = DEFAULT_SETTINGS,
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
        transition = simulate_step(scene, pose, command, stiffness, settings, previous, unusual)
        transitions.append(transition)
        pose, previous = transition.pose, command
    return transitions


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether autograd is recording for any of the tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _flat(
    scene: ContactScene,
    batch: torch.Size,
    pose: Tensor,
    previous: Tensor | None,
    command: Tensor,
    stiffness: Tensor,
) -> Asked:
    """What is asked with one batch axis, in float64 on the CPU; outlines and planes as they are in
    the scene."""

    def ready(value: Tensor, *axes: int) -> Tensor:
        if value.device.type != "cpu":
            _tell_once(value.device.type)
        return value.reshape(-1, *axes).to("cpu", torch.float64)

    def each(value: Tensor) -> Tensor:
        return ready(value.expand(*batch, 3), 3)

    terrains, outlines = len(scene.terrains), scene.points_ee.shape[:-2]
    owner = torch.arange(scene.batch_shape.numel()).reshape(scene.batch_shape)
    owner = owner.expand(batch).reshape(-1)
    outline = torch.arange(outlines.numel()).reshape(outlines).expand(scene.batch_shape)
    return Asked(
        points=ready(scene.points_ee, *scene.points_ee.shape[-2:]),
        normals=ready(torch.stack([body.direction for body in scene.terrains], -2), terrains, 2),
        offsets=ready(torch.stack([body.offset for body in scene.terrains], -1), terrains),
        friction=ready(scene.friction, terrains),
        compliance=ready(scene.compliance, terrains),
        start=each(pose),
        previous=None if previous is None else each(previous),
        command=each(command),
        stiffness=each(stiffness) if stiffness.ndim > 1 else ready(stiffness, 3),
        reliefs=tuple(body.relief for body in scene.terrains),
        outline=outline.reshape(-1)[owner],
        scene=owner,
    )


@cache
def _tell_once(device: str) -> None:
    warnings.warn(f"contact is solved on the CPU, not on {device}", stacklevel=4)


def _part(asked: Asked, index: Tensor) -> Asked:
    """Some of the transitions."""
    each = ("start", "previous", "command", "outline", "scene")
    each = (*each, "stiffness") if len(asked.stiffness) > 1 else each
    values = {name: getattr(asked, name) for name in each}
    return asked._replace(**{n: v if v is None else v[index] for n, v in values.items()})


def _settle(asked: Asked, settings: StepSettings, device: torch.device) -> Answered:
    if needs_gradient(asked.normals) and any(asked.reliefs):
        raise ValueError("a relief has no derivative by its direction; detach it")
    if needs_gradient(*(value for value in asked if isinstance(value, Tensor))):
        return Answered(*_Settle.apply(settings, device, *asked))
    return step(asked, settings, device=device)


class _Settle(torch.autograd.Function):
    """The compiled step; its derivatives are carried forward through the parts of the path, so that
    the way back is a contraction. Only the pose is differentiable."""

    @staticmethod
    def forward(
        ctx: Any, settings: StepSettings, device: torch.device, *inputs: Any
    ) -> tuple[Tensor, ...]:
        """Step, and keep the derivatives."""
        asked = Asked(*inputs)
        found = step(asked, settings, gradient=True, device=device)
        ctx.mark_non_differentiable(*found[1:])
        ctx.save_for_backward(
            found.status, found.from_start, found.from_gap, found.from_inputs, found.from_points,
            asked.normals, asked.outline, asked.scene,
        )  # fmt: skip
        ctx.sizes = (len(asked.points), len(asked.offsets), len(asked.stiffness))
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, by_pose: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        """What a number answers to the inputs, from what it answers to the settled pose."""
        if torch.is_grad_enabled():
            raise RuntimeError("a step is differentiable once; leave out create_graph=True")
        status, from_start, from_gap, from_inputs, from_points, *places = ctx.saved_tensors
        normals, outline, scene = places
        outlines, scenes, shared = ctx.sizes
        invalid = status == int(StepStatus.INVALID_INPUT)
        by_pose = by_pose.masked_fill(invalid[:, None], 0.0)

        def pulled(slopes: Tensor) -> Tensor:
            slopes = slopes.masked_fill(invalid.reshape(-1, *[1] * (slopes.ndim - 1)), 0.0)
            return (slopes * by_pose.reshape(-1, *[1] * (slopes.ndim - 2), 3)).sum(-1)

        def gathered(values: Tensor, index: Tensor, count: int) -> Tensor:
            return values.new_zeros(count, *values.shape[1:]).index_add_(0, index, values)

        terrains = from_gap.shape[1]
        sizes = (terrains, terrains, terrains, 3, 3, 3)
        friction, compliance, angle, stiffness, previous, command = pulled(from_inputs).split(
            sizes, -1
        )
        across = torch.stack((-normals[..., 1], normals[..., 0]), dim=-1)
        given = ctx.needs_input_grad[2:]
        return (
            None,
            None,
            gathered(pulled(from_points), outline, outlines) if given[0] else None,
            gathered(angle, scene, scenes)[..., None] * across,
            gathered(-pulled(from_gap), scene, scenes),
            gathered(friction, scene, scenes),
            gathered(compliance, scene, scenes),
            pulled(from_start.mT),
            previous if given[6] else None,
            command,
            stiffness.sum(0, keepdim=True) if shared == 1 else stiffness,
            None,
            None,
            None,
        )
