"""The surroundings as half-planes: floor, wall, and any that are tilted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

OFF_UNIT = 2e-3
"""What the square of a direction's length may differ from 1, as of one rounded to three digits."""


@dataclass(frozen=True)
class HalfPlane:
    """All points p with n·p <= offset; `direction` n is the outward unit normal."""

    direction: Float[Tensor, "*batch 2"]
    offset: Float[Tensor, "*batch"]

    def signed_distance(
        self, points_world: Float[Tensor, "*batch p 2"]
    ) -> Float[Tensor, "*batch p"]:
        """Distance n·p - offset [m]."""
        return (points_world * self.direction[..., None, :]).sum(-1) - self.offset[..., None]

    def double(self) -> HalfPlane:
        """The same half-planes in float64."""
        return HalfPlane(self.direction.double(), self.offset.double())

    def expand(self, batch: torch.Size) -> HalfPlane:
        """The same half-planes for a larger batch."""
        return HalfPlane(self.direction.expand(*batch, 2), self.offset.expand(batch))

    def gather(self, index: Int[Tensor, "*batch"]) -> HalfPlane:
        """The half-planes at positions `index` of the flattened batch."""
        return HalfPlane(self.direction.reshape(-1, 2)[index], self.offset.reshape(-1)[index])


def floor(height: Float[Tensor, "*batch"]) -> HalfPlane:
    """Floor below world z = height [m]; its normal points up."""
    return HalfPlane(_constant_direction(height, 0.0, 1.0), height)


def wall(position: Float[Tensor, "*batch"]) -> HalfPlane:
    """Wall beyond world x = position [m]; its normal points towards -x."""
    return HalfPlane(_constant_direction(position, -1.0, 0.0), -position)


def _constant_direction(like: Tensor, x: float, z: float) -> Tensor:
    return torch.stack((torch.full_like(like, x), torch.full_like(like, z)), dim=-1)
