"""Which outline points come lowest over each terrain: the scan that finds contact candidates.

Only half-planes have a short cut: their normals are turned into the object frame, so that
the heights of all points over all terrains are one batched matrix product.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.contact import ContactScene, terrain_gaps
from tpcd.planar import perpendicular, rotate
from tpcd.terrain import HalfPlane


def lowest_points(
    scene: ContactScene,
    pose: Float[Tensor, "b 3"],
    leans: Float[Tensor, "b t k"],
    start: Float[Tensor, "b 3"] | None = None,
) -> tuple[Float[Tensor, "b t k"], Int[Tensor, "b t k"]]:
    """Least score over the outline, and the point that has it, for k leans and t terrains.

    The score of a point is its gap [m] plus lean times its tangential position over the end
    effector [m], so that lean 0 asks for the lowest point, and a small lean for the lowest
    one after a turn by so many radians. With `start` the lean multiplies the part of the
    tangential position that is new since that pose, which is slip but for a shift.
    """
    planes = [body for body in scene.terrains if isinstance(body, HalfPlane)]
    if len(planes) < len(scene.terrains):
        gaps, levers = terrain_gaps(scene.points_ee, scene.terrains, pose)
        if start is not None:
            levers = levers - terrain_gaps(scene.points_ee, scene.terrains, start)[1]
        scores = gaps[:, :, None, :] + leans[..., None] * levers[:, :, None, :]
        lowest, index = scores.min(-1)
        return lowest, index
    directions = torch.stack([body.direction for body in planes], dim=-2)
    offsets = torch.stack([body.offset for body in planes], dim=-1)
    shift = (directions * pose[:, None, :2]).sum(-1) - offsets
    turned = rotate(-pose[:, 2, None], directions)
    lean_by = -perpendicular(turned)
    if start is not None:
        lean_by = lean_by + perpendicular(rotate(-start[:, 2, None], directions))
    asked = turned[:, :, None, :] + leans[..., None] * lean_by[:, :, None, :]
    scores = torch.bmm(asked.flatten(1, 2), scene.points_ee.mT)
    lowest, index = scores.min(-1)
    return lowest.reshape(leans.shape) + shift[..., None], index.reshape(leans.shape)
