"""The parameters theta of the contact model, their order, names and units.

theta = latent (d_z) · scale · mount (x, z, angle) · friction · floor height · wall
position. `Parameters` holds them as named tensors with any batch axes in front; the flat
vector form (`to_vector`, `from_vector`) is what samplers move and files store.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

SCENE_NAMES = (
    "scale",
    "mount_x",
    "mount_z",
    "mount_phi",
    "friction",
    "floor_height",
    "wall_position",
)
SCENE_UNITS = ("1", "m", "m", "rad", "1", "m", "m")
DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {
    "scale": (0.8, 1.2),
    "mount_x": (-0.02, 0.02),
    "mount_z": (-0.02, 0.02),
    "mount_phi": (-0.2, 0.2),
    "friction": (0.1, 0.9),
    "floor_height": (-0.02, 0.02),
    "wall_position": (0.09, 0.18),
}
"""Priors used in simulation, uniform on [low, high]; floor and wall in world coordinates."""
LARGEST_FRICTION = 100.0
"""Largest friction coefficient. Nothing slips there unless it is pulled within half a degree along
the terrain; with more, rounding decides which of the rows of a contact holds."""


@dataclass(frozen=True)
class Parameters:
    """One theta for each element of the batch.

    `latent` is dimensionless in [-1, 1]; `scale` and `friction` are dimensionless; `mount`
    is the pose of the object in the end-effector frame [m, m, rad]; `floor_height` is the
    world z of the floor and `wall_position` the world x of the wall [m].
    """

    latent: Float[Tensor, "*batch z"]
    scale: Float[Tensor, "*batch"]
    mount: Float[Tensor, "*batch 3"]
    friction: Float[Tensor, "*batch"]
    floor_height: Float[Tensor, "*batch"]
    wall_position: Float[Tensor, "*batch"]

    @property
    def latent_dim(self) -> int:
        """Number of shape latents d_z."""
        return self.latent.shape[-1]

    def to_vector(self) -> Float[Tensor, "*batch d"]:
        """Stack theta in its fixed order; d = d_z + 7."""
        scene = (self.scale, self.mount, self.friction, self.floor_height, self.wall_position)
        columns = [value if value.ndim > self.scale.ndim else value[..., None] for value in scene]
        return torch.cat((self.latent, *columns), dim=-1)

    @staticmethod
    def from_vector(vector: Float[Tensor, "*batch d"]) -> Parameters:
        """Read theta from its flat form; the latent takes what the 7 scene entries leave."""
        z = vector.shape[-1] - len(SCENE_NAMES)
        if z < 0:
            raise ValueError(
                f"theta has {vector.shape[-1]} entries, expected at least {len(SCENE_NAMES)}"
            )
        return Parameters(
            latent=vector[..., :z],
            scale=vector[..., z],
            mount=vector[..., z + 1 : z + 4],
            friction=vector[..., z + 4],
            floor_height=vector[..., z + 5],
            wall_position=vector[..., z + 6],
        )


def parameter_names(latent_dim: int) -> tuple[str, ...]:
    """Names of the entries of theta in order."""
    return tuple(f"latent_{i}" for i in range(latent_dim)) + SCENE_NAMES


def parameter_units(latent_dim: int) -> tuple[str, ...]:
    """SI units of the entries of theta in order ('1' for dimensionless)."""
    return ("1",) * latent_dim + SCENE_UNITS
