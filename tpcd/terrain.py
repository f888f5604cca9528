"""The surroundings as half-planes, with or without a relief: floor, wall, and tilted ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

OFF_UNIT = 2e-3
"""What the square of a direction's length may differ from 1, as of one rounded to three digits."""


@dataclass(frozen=True)
class Relief:
    """Heights over a plane [m] and slopes at g places (`first` + k) `pitch` [m] along its tangent,
    (n_z, -n_x): along x on a floor, along z on a wall. Between them it is a cubic Hermite spline,
    and level beyond. One relief serves a whole batch, and carries no gradient."""

    rise: Float[Tensor, " g"]
    slope: Float[Tensor, " g"]
    first: int
    pitch: float

    def __post_init__(self) -> None:
        """Refuse what is no relief."""
        if self.rise.ndim != 1 or self.rise.shape != self.slope.shape or len(self.rise) < 2:
            shapes = f"{tuple(self.rise.shape)} and {tuple(self.slope.shape)}"
            raise ValueError(f"rise and slope have shapes {shapes}, expected (g) twice, g >= 2")
        if not 0 < self.pitch < math.inf:
            raise ValueError(f"pitch is {self.pitch}, expected a length [m] above 0")
        for name in ("rise", "slope"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise ValueError(f"{name} of a relief holds a NaN or an infinity")

    @classmethod
    def of(
        cls, height: Callable[[Tensor], Tensor], low: float, high: float, pitch: float = 0.00025
    ) -> Relief:
        """That of a differentiable function of the place [m], between two places."""
        first = math.floor(low / pitch)
        places = pitch * torch.arange(first, math.ceil(high / pitch) + 1, dtype=torch.float64)
        with torch.enable_grad():
            places.requires_grad_()
            rise = height(places)
            (slope,) = torch.autograd.grad(rise.sum(), places)
        return cls(rise.detach(), slope, first, pitch)

    def __call__(self, place: Float[Tensor, "*batch"]) -> tuple[Tensor, Tensor]:
        """Height [m] and slope at places [m]."""
        u = (place / self.pitch - self.first).clamp(0, len(self.rise) - 1)
        k = u.floor().long().clamp_max(len(self.rise) - 2)
        u, (a, b) = u - k, (self.rise[k], self.rise[k + 1])
        c, d = self.pitch * self.slope[k], self.pitch * self.slope[k + 1]
        square, cube = 3 * (b - a) - 2 * c - d, 2 * (a - b) + c + d
        inside = (place / self.pitch - self.first).clamp(0, len(self.rise) - 1) == (
            place / self.pitch - self.first
        )
        slope = (c + u * (2 * square + 3 * u * cube)) / self.pitch
        return a + u * (c + u * (square + u * cube)), torch.where(inside, slope, 0.0)


@dataclass(frozen=True)
class HalfPlane:
    """All points p with n·p <= offset, and what a `relief` adds to them; `direction` n is the
    outward unit normal."""

    direction: Float[Tensor, "*batch 2"]
    offset: Float[Tensor, "*batch"]
    relief: Relief | None = None

    def signed_distance(
        self, points_world: Float[Tensor, "*batch p 2"]
    ) -> Float[Tensor, "*batch p"]:
        """Distance n·p - offset [m]; over a relief to first order."""
        normal = self.direction[..., None, :]
        gap = (points_world * normal).sum(-1) - self.offset[..., None]
        if self.relief is None:
            return gap
        along = (points_world.flip(-1) * normal).diff(dim=-1)[..., 0]
        rise, slope = self.relief(along)
        return (gap - rise) * (1 + slope**2).rsqrt()

    def double(self) -> HalfPlane:
        """The same half-planes in float64."""
        return replace(self, direction=self.direction.double(), offset=self.offset.double())

    def expand(self, batch: torch.Size) -> HalfPlane:
        """The same half-planes for a larger batch."""
        direction = self.direction.expand(*batch, 2)
        return replace(self, direction=direction, offset=self.offset.expand(batch))

    def gather(self, index: Int[Tensor, "*batch"]) -> HalfPlane:
        """The half-planes at positions `index` of the flattened batch."""
        direction = self.direction.reshape(-1, 2)[index]
        return replace(self, direction=direction, offset=self.offset.reshape(-1)[index])


def floor(height: Float[Tensor, "*batch"]) -> HalfPlane:
    """Floor below world z = height [m]; its normal points up."""
    return HalfPlane(_constant_direction(height, 0.0, 1.0), height)


def wall(position: Float[Tensor, "*batch"]) -> HalfPlane:
    """Wall beyond world x = position [m]; its normal points towards -x."""
    return HalfPlane(_constant_direction(position, -1.0, 0.0), -position)


def _constant_direction(like: Tensor, x: float, z: float) -> Tensor:
    return torch.stack((torch.full_like(like, x), torch.full_like(like, z)), dim=-1)
