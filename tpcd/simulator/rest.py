"""Whether an answer is at rest, whatever found it, and whether a start pose can have been one.

At rest the object is inside no terrain, bears the load of what it touches alone, and the wrench
K (x' - u) is the sum of the contact forces. How far an answer is from that is told as a length:
what the forces do not balance by the way that the arm would still go for it, turns by the way of
the furthest point of the outline. The arm knows angles to half a turn: where the object is turned
further from its command, the spring pulls another way, and nothing rests. `kernel_rest` is the same
in compiled loops.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.implicit import loaded_frames
from tpcd.simulator.loaded import terrain_load
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.record import ContactSet, StepSettings


@torch.no_grad()
def terrain_gaps_under(
    scene: ContactScene, pose: Float[Tensor, "b 3"], load: Float[Tensor, "b t"]
) -> Float[Tensor, "b t"]:
    """Gap to each terrain where it has yielded to its load [N], in metres."""
    gaps, _ = lowest_points(scene, pose, pose.new_zeros(*scene.friction.shape, 1))
    return gaps[..., 0] + scene.compliance * load


@torch.no_grad()
def distance_from_rest(
    scene: ContactScene,
    pose: Float[Tensor, "b 3"],
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "*each 3"],
    contacts: ContactSet,
    settings: StepSettings,
) -> Float[Tensor, " b"]:
    """How far poses, with the contacts that bear load there, are from rest [m]; infinite where
    that is no number. Convex friction may push on what is away from the terrain."""
    load = terrain_load(contacts, scene.friction.shape[-1])
    gaps = terrain_gaps_under(scene, pose, load)
    pushed = (load > 0) & (settings.friction == "coulomb")
    off = torch.where(pushed, gaps.abs(), -gaps).amax(-1)
    frames = loaded_frames(scene, pose, contacts)
    slope = (contacts.side * scene.friction.gather(-1, contacts.terrain))[..., None]
    pushes = contacts.multiplier[..., None] * (frames.normal_row + slope * frames.tangent_row)
    stretched = pose - command
    turned = (stretched[:, 2] / (2 * math.pi)).round().abs() * (2 * math.pi)
    unbalanced = (stretched - pushes.sum(-2) / stiffness).abs()
    extent = scene.points_ee.norm(dim=-1).amax(-1)
    off = off.maximum(unbalanced[:, :2].amax(-1)).maximum(unbalanced[:, 2] * extent)
    off = off.maximum(turned * extent)
    return torch.where(torch.isfinite(off), off, torch.inf)
