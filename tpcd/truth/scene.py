"""A simulated scene: an outline in the hand, a floor, a wall, friction, and a free start.

Theta is drawn uniformly from the priors; a point of the outline goes object -> scale ->
mount -> end-effector frame. Lengths in metres, angles in radians, float64 on the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.parameters import DEFAULT_BOUNDS, LARGEST_FRICTION, SCENE_NAMES
from tpcd.planar import transform_points

DEFAULT_STIFFNESS = (100.0, 100.0, 50.0)
START_HEIGHTS = (0.010, 0.020)
"""Clearance over the floor of a drawn start pose, uniform [m]."""
START_WALL_CLEARANCE = 0.020
"""Least clearance from the wall of a drawn start pose [m]."""


@dataclass(frozen=True)
class Scene:
    """One object in one world; what a truth needs and an estimator must find out."""

    outline_name: str
    outline_vertices: Float[Tensor, "p 2"]
    """In the object frame at scale 1 [m]."""
    scale: float
    mount: Float[Tensor, " 3"]
    """Pose of the object in the end-effector frame [m, m, rad]."""
    friction: float
    floor_height: float
    wall_position: float
    start_pose: Float[Tensor, " 3"]
    """Free pose of the end effector from which every episode starts [m, m, rad]."""
    stiffness: Float[Tensor, " 3"] = field(
        default_factory=lambda: torch.tensor(DEFAULT_STIFFNESS, dtype=torch.float64)
    )
    """Diagonal of K [N/m, N/m, N·m/rad]."""

    def __post_init__(self) -> None:
        if not 0 <= self.friction <= LARGEST_FRICTION:
            raise ValueError(
                f"friction is {self.friction:g}, expected 0 to {LARGEST_FRICTION:g}, where nothing"
                " slips any more"
            )
        floor_gap, wall_gap = self.clearances(self.start_pose)
        for name, gap in (("floor", floor_gap), ("wall", wall_gap)):
            if gap <= 0:
                x, z, angle = self.start_pose.tolist()
                raise ValueError(
                    f"start pose ({x:.4g}, {z:.4g}, {angle:.4g}) is {-gap * 1e3:.2f} mm inside the"
                    f" {name}, expected to be free of contact; move it away from the {name}"
                )

    @property
    def vertices_ee(self) -> Float[Tensor, "p 2"]:
        """The outline's vertices, scaled and mounted, in the end-effector frame [m]."""
        return transform_points(self.mount, self.scale * self.outline_vertices)

    @property
    def theta(self) -> dict[str, float]:
        """The scene entries of theta by name, in their order."""
        values = (self.scale, *self.mount.tolist(), self.friction)
        return dict(zip(SCENE_NAMES, (*values, self.floor_height, self.wall_position), strict=True))

    def clearances(self, pose: Float[Tensor, " 3"]) -> tuple[float, float]:
        """Distance of the object at a pose from floor and wall [m], negative inside."""
        points = transform_points(pose, self.vertices_ee)
        floor_gap = float(points[:, 1].min()) - self.floor_height
        return floor_gap, self.wall_position - float(points[:, 0].max())


def draw_scene(
    outline_name: str,
    outline_vertices: Float[np.ndarray, "p 2"],
    generator: torch.Generator,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    stiffness: tuple[float, ...] = DEFAULT_STIFFNESS,
    start_pose: tuple[float, ...] | None = None,
) -> Scene:
    """Draw theta from uniform priors and choose a free start pose.

    `fixed` holds entries of theta that are given instead of drawn; every entry is drawn all
    the same, so fixing one leaves the others as they were. `bounds` replaces single priors.
    Without `start_pose` the arm starts at x = 0, shifted left where the object would come
    near the wall, upright, and 10 to 20 mm above the floor. Raises `ValueError` for unknown
    names, values without meaning, and a start pose in penetration.
    """
    ranges = {**DEFAULT_BOUNDS, **(bounds or {})}
    fixed = dict(fixed or {})
    for name in (*ranges, *fixed):
        if name not in SCENE_NAMES:
            raise ValueError(f"unknown scene parameter {name!r}, known are {SCENE_NAMES}")
    uniform = torch.rand(len(SCENE_NAMES) + 1, generator=generator, dtype=torch.float64).tolist()
    theta = {}
    for name, draw in zip(SCENE_NAMES, uniform, strict=False):
        low, high = ranges[name]
        theta[name] = fixed.get(name, low + draw * (high - low))
    if theta["scale"] <= 0 or theta["friction"] < 0:
        raise ValueError(
            f"scale is {theta['scale']}, friction {theta['friction']}; expected > 0 and >= 0"
        )
    if start_pose is not None and len(start_pose) != 3:
        raise ValueError(f"start pose has {len(start_pose)} numbers, expected x, z, phi")
    vertices = torch.tensor(np.asarray(outline_vertices), dtype=torch.float64)
    mount = torch.tensor(
        [theta["mount_x"], theta["mount_z"], theta["mount_phi"]], dtype=torch.float64
    )
    if start_pose is None:
        points = transform_points(mount, theta["scale"] * vertices)
        low, high = START_HEIGHTS
        height = low + uniform[-1] * (high - low)
        reach = theta["wall_position"] - START_WALL_CLEARANCE - float(points[:, 0].max())
        start_pose = (
            min(0.0, reach), theta["floor_height"] + height - float(points[:, 1].min()), 0.0
        )  # fmt: skip
    return Scene(
        outline_name=outline_name,
        outline_vertices=vertices,
        scale=theta["scale"],
        mount=mount,
        friction=theta["friction"],
        floor_height=theta["floor_height"],
        wall_position=theta["wall_position"],
        start_pose=torch.tensor(start_pose, dtype=torch.float64),
        stiffness=torch.tensor(stiffness, dtype=torch.float64),
    )
