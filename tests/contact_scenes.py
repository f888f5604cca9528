"""Small scenes and random transitions that the tests of contact and simulator share."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.contact import ContactScene, place_points, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import transform_points
from tpcd.shape.builtin import builtin_outlines, make_entry
from tpcd.shape.household import ENTRIES
from tpcd.shape.polygon import PolygonShape
from tpcd.terrain import floor, wall

STIFFNESS = torch.tensor((100.0, 100.0, 50.0), dtype=torch.float64)
"""K [N/m, N/m, N·m/rad]."""
OUTLINES = (
    "soup_can",
    "beer_bottle",
    "mug",
    "hammer",
    "tennis_ball",
    "banana",
    "hex_nut",
    "wine_glass",
    "c_clamp",
    "egg",
    "saucepan",
    "wrench",
)
"""Built-in outlines of every kind: round, flat, convex or not, slender."""


def vector(*values: float) -> Tensor:
    """A float64 vector, or a matrix from rows."""
    return torch.tensor(values, dtype=torch.float64)


BOX = vector([-0.03, -0.05], [0.03, -0.05], [0.03, 0.05], [-0.03, 0.05])
"""Corners of a box of 60 x 100 mm about the end effector [m]."""
SLAB = vector([-0.06, -0.02], [0.06, -0.02], [0.06, 0.02], [-0.06, 0.02])
"""A box of 120 x 40 mm: too low to tip under its own friction."""


def make_scene(
    points: Tensor = BOX,
    friction: float | Tensor = 0.4,
    height: float | Tensor = 0.0,
    position: float | Tensor = 0.3,
    compliance: float | Tensor = 0.0,
) -> ContactScene:
    """Floor and wall around an outline; numbers may be batched, the compliance with an axis for
    the terrains."""
    friction, height, position, compliance = (
        torch.as_tensor(value, dtype=torch.float64)
        for value in (friction, height, position, compliance)
    )
    batch = torch.broadcast_shapes(friction.shape, height.shape, position.shape, points.shape[:-2])
    return ContactScene(
        points_ee=points.expand(*batch, *points.shape[-2:]),
        terrains=(floor(height.expand(batch)), wall(position.expand(batch))),
        friction=friction.expand(batch)[..., None].expand(*batch, 2),
        compliance=compliance.expand(*batch, 2),
    )


@cache
def outline_points(name: str, points: int = 96) -> Tensor:
    """Boundary points of a built-in outline in its own frame [m]."""
    shape = PolygonShape(make_entry(name, ENTRIES[name]), max_points=points)
    return shape.boundary_points(torch.zeros(0, dtype=torch.float64))


def random_transitions(
    points: Tensor, count: int, seed: int
) -> tuple[ContactScene, Tensor, Tensor]:
    """Scenes of one outline with start poses and commands, as exploration meets them.

    Scale, mount, friction, floor and wall come from the priors of simulated episodes. The
    start is free, touching, or penetrating by a measurement error of up to 0.3 mm, with
    each terrain on its own; commands go up to 5 N into a terrain, up to 30 mm away from it,
    and to any angle within 0.15 rad.
    """
    random = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        draw = torch.rand(count, *shape, generator=random, dtype=torch.float64)
        return low + (high - low) * draw

    mount = torch.cat((uniform(-0.02, 0.02, 2), uniform(-0.2, 0.2, 1)), dim=-1)
    scene = make_scene(
        place_points(points.expand(count, *points.shape), uniform(0.8, 1.2), mount),
        uniform(0.1, 0.9),
        uniform(-0.02, 0.02),
        uniform(0.09, 0.18),
    )
    poses = []
    depth = torch.where(uniform(0, 1, 2) < 0.3, uniform(-0.0003, 0.0003, 2), -uniform(0, 0.02, 2))
    depth = torch.where(uniform(0, 1, 2) < 0.4, 0.0, depth)
    press = torch.where(uniform(0, 1, 2) < 0.7, uniform(0, 0.05, 2), -uniform(0, 0.03, 2))
    for inside in (depth, press):
        angle = uniform(-0.15, 0.15)
        turned = transform_points(
            torch.stack((0 * angle, 0 * angle, angle), dim=-1), scene.points_ee
        )
        x = scene_wall(scene) - turned[..., 0].amax(-1) + inside[:, 0]
        z = scene_floor(scene) - turned[..., 1].amin(-1) - inside[:, 1]
        poses.append(torch.stack((x, z, angle), dim=-1))
    return scene, poses[0], poses[1]


def scene_floor(scene: ContactScene) -> Tensor:
    """Height of the floor [m] of scenes made here."""
    return scene.terrains[0].offset


def scene_wall(scene: ContactScene) -> Tensor:
    """World x of the wall [m] of scenes made here."""
    return -scene.terrains[1].offset


def many_random_transitions(count: int, seed: int) -> tuple[ContactScene, Tensor, Tensor]:
    """`random_transitions` of all outlines in turn, `count` for each, in one flat batch."""
    parts = [
        random_transitions(outline_points(name), count, seed + k) for k, name in enumerate(OUTLINES)
    ]
    most = max(scene.points_ee.shape[-2] for scene, _, _ in parts)
    points = [
        # A repeated point changes nothing: it touches where the first one does.
        torch.cat((p, p[:, :1].expand(-1, most - p.shape[1], 2)), dim=1)
        for p in (scene.points_ee for scene, _, _ in parts)
    ]
    scene = make_scene(
        torch.cat(points),
        torch.cat([scene.friction[:, 0] for scene, _, _ in parts]),
        torch.cat([scene_floor(scene) for scene, _, _ in parts]),
        torch.cat([scene_wall(scene) for scene, _, _ in parts]),
    )
    return scene, torch.cat([start for _, start, _ in parts]), torch.cat([c for *_, c in parts])


def rotated(points: Tensor, angle: float) -> Tensor:
    """Points turned about the origin by an angle [rad]."""
    return transform_points(vector(0.0, 0.0, angle), points)


def regular_polygon(count: int, radius: float) -> Tensor:
    """Corners of a regular polygon about the origin [m]."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    return radius * torch.stack((angles.cos(), angles.sin()), dim=-1)


def flush_corner(count: int) -> tuple[ParameterPrior, Tensor, Tensor, Tensor, Tensor]:
    """Cartons of many sizes and frictions that stand flush in a corner: their prior and theta, a
    start pose and two commands that press them into it."""
    prior = make_prior(PolygonShape(builtin_outlines()["milk_carton"]))
    generator = torch.Generator().manual_seed(2)
    vectors = prior.to_vector(prior.sample(count, generator))
    place = prior.names.index
    points = scene_from_parameters(prior.shape, Parameters.from_vector(vectors)).points_ee
    vectors[:, place("floor_height")] = points[..., 1].amin(-1)
    vectors[:, place("wall_position")] = points[..., 0].amax(-1)
    friction = torch.rand(count, generator=generator, dtype=torch.float64)
    vectors[:, place("friction")] = 0.2 + 0.7 * friction
    start, before, command = (
        torch.tensor(each, dtype=torch.float64)
        for each in ((0.003, -0.003, 0.01), (0.01, -0.01, 0.0), (0.004, -0.02, 0.03))
    )
    return prior, vectors, start, before, command
