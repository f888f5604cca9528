"""The scene of a contact step: the outline of the held object in the end-effector frame, and the
terrains that it can touch, for each element of a batch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.contract import as_numbers, one_batch
from tpcd.parameters import Parameters
from tpcd.planar import transform_points
from tpcd.shape.protocol import Shape
from tpcd.terrain import HalfPlane, floor, wall


@dataclass(frozen=True)
class ContactScene:
    """An object in the hand and the terrains around it.

    `points_ee` are outline points in the end-effector frame [m], `terrains` the t bodies of
    the world, `friction` the Coulomb coefficient of the object against each of them, and
    `compliance` [m/N] how far each yields along its normal, as a spring; 0, and where it is left
    out, for what is rigid. Batch axes in front are broadcast, but those of the outlines may stay of
    length 1. Arrays and lists are taken for tensors; TypeError and ValueError for other shapes.
    """

    points_ee: Float[Tensor, "*#batch p 2"]
    terrains: tuple[HalfPlane, ...]
    friction: Float[Tensor, "*batch t"]
    compliance: Float[Tensor, "*batch t"] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Bring all to one batch, and make terrains rigid where nothing else is said."""
        points, count = as_numbers("points_ee", self.points_ee, 2), len(self.terrains)
        if points.ndim < 2 or 0 in (points.shape[-2], count):
            told = f"points_ee has shape {tuple(points.shape)} against {count} terrains"
            raise ValueError(f"{told}, expected rows of 2 numbers, and of each at least one")
        friction = as_numbers("friction", self.friction, count, device=points.device)
        compliance = torch.zeros_like(friction) if self.compliance is None else self.compliance
        compliance = as_numbers("compliance", compliance, count, device=points.device)
        shapes = {
            "points_ee": points.shape[:-2],
            "friction": friction.shape[:-1],
            "compliance": compliance.shape[:-1],
        }
        for t, body in enumerate(self.terrains):
            if not isinstance(body, HalfPlane):
                raise TypeError(f"terrain {t} is a {type(body).__name__}, expected a HalfPlane")
            shapes[f"direction of terrain {t}"] = body.direction.shape[:-1]
            shapes[f"offset of terrain {t}"] = body.offset.shape
        batch = one_batch(shapes)
        terrains = tuple(body.expand(batch) for body in self.terrains)
        object.__setattr__(self, "points_ee", points)
        object.__setattr__(self, "terrains", terrains)
        object.__setattr__(self, "friction", friction.expand(*batch, count))
        object.__setattr__(self, "compliance", compliance.expand(*batch, count))

    @property
    def batch_shape(self) -> torch.Size:
        """Leading axes of the scene."""
        return self.friction.shape[:-1]

    @property
    def yields(self) -> Bool[Tensor, "*batch"]:
        """Where any terrain yields, or its compliance is no number."""
        return (self.compliance != 0).any(-1)

    def double(self) -> ContactScene:
        """The same scene in float64."""
        return ContactScene(
            self.points_ee.double(),
            tuple(body.double() for body in self.terrains),
            self.friction.double(),
            self.compliance.double(),
        )

    def gather(self, index: Int[Tensor, "*batch"]) -> ContactScene:
        """The scenes at positions `index` of the flattened batch."""
        points = self.points_ee
        points = points.expand(*self.batch_shape, *points.shape[-2:])
        return ContactScene(
            points_ee=points.reshape(-1, *points.shape[-2:]).index_select(0, index),
            terrains=tuple(body.gather(index) for body in self.terrains),
            friction=self.friction.reshape(-1, self.friction.shape[-1])[index],
            compliance=self.compliance.reshape(-1, self.friction.shape[-1])[index],
        )

    def further(self, gap: Float[Tensor, "*batch t"]) -> ContactScene:
        """The same with half-planes that are further away by `gap` [m]."""
        planes = []
        for body, more in zip(self.terrains, gap.unbind(-1), strict=True):
            offset = body.offset - more
            direction = body.direction.expand(*offset.shape, 2)
            planes.append(replace(body, direction=direction, offset=offset))
        return ContactScene(self.points_ee, tuple(planes), self.friction, self.compliance)

    def columns(self, index: Int[Tensor, " n"]) -> ContactScene:
        """The scenes at positions `index` of the last batch axis, where it has more than one."""

        def pick(value: Tensor, axis: int) -> Tensor:
            return value if value.shape[axis] == 1 else value.index_select(axis, index)

        planes = []
        for body in self.terrains:
            direction, offset = pick(body.direction, -2), pick(body.offset, -1)
            planes.append(replace(body, direction=direction, offset=offset))
        more = (pick(self.friction, -2), pick(self.compliance, -2))
        return ContactScene(pick(self.points_ee, -3), tuple(planes), *more)


def place_points(
    points_object: Float[Tensor, "*batch p 2"],
    scale: Float[Tensor, "*batch"],
    mount: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch p 2"]:
    """Outline points in the end-effector frame [m]: scaled, then moved by the mount."""
    return transform_points(mount, scale[..., None, None] * points_object)


def scene_from_parameters(
    shape: Shape, parameters: Parameters, points_ee: Float[Tensor, "*batch p 2"] | None = None
) -> ContactScene:
    """The scene that theta describes: decoded outline, floor and wall, one friction for both.

    `points_ee` are the outlines in the end-effector frame where they are decoded already.
    """
    if points_ee is None:
        points = shape.boundary_points(parameters.latent)
        points_ee = place_points(points, parameters.scale, parameters.mount)
    friction = parameters.friction[..., None]
    return ContactScene(
        points_ee=points_ee,
        terrains=(floor(parameters.floor_height), wall(parameters.wall_position)),
        friction=torch.cat((friction, friction), dim=-1),
    )


def column_scene(scene: ContactScene) -> ContactScene:
    """The scenes of m particles with an axis for transitions after theirs: batch (m, 1)."""
    planes = []
    for body in scene.terrains:
        direction, offset = body.direction[..., None, :], body.offset[..., None]
        planes.append(replace(body, direction=direction, offset=offset))
    return ContactScene(
        scene.points_ee[..., None, :, :],
        tuple(planes),
        scene.friction[..., None, :],
        scene.compliance[..., None, :],
    )


def terrain_gaps(
    scene: ContactScene, pose: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch2 t p"]:
    """Gap of every outline point to every terrain [m] at poses [m, m, rad]."""
    points = transform_points(pose, scene.points_ee)
    return torch.stack([body.signed_distance(points) for body in scene.terrains], dim=-2)
