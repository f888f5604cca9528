"""A history as it looks to particles with effects: conditions, merged readings, and parity.

A settled row carries the pose twice: measured directly, and through the wrench, since
w = S K (x' - u) + b with the sensor's matrix S and bias b. The two are merged into one estimate
of the settled pose with diagonal covariance (inverse-variance weights). What they disagree
about, the parity residual, holds no information on theta, but on effects of the arm and of the
sensors; it also tells a bad reading from a good one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.effects.conditions import Conditions, angle_difference

PARITY_LIMIT = 16.3
"""Parity chi-square (3 degrees of freedom) beyond which a reading counts as bad: 0.1 %."""


@dataclass(frozen=True)
class Merged:
    """Estimates of the settled poses of r rows, for c = 1 or m particles."""

    poses: Float[Tensor, "#c r 3"]
    """From pose and wrench together [m, m, rad]."""
    variance: Float[Tensor, "#c r 3"]
    """In their squares."""
    offset: Float[Tensor, "#c r 3"]
    """Pose that the wrench tells minus the pose that was measured [m, m, rad]."""
    scale: Float[Tensor, "#c r 3"]
    """Standard deviation of the offset."""
    log_units: Float[Tensor, "#c r"]
    """Log of the volume of wrench [N, N, N·m] for each volume of pose."""

    @property
    def chi_square(self) -> Float[Tensor, "#c r"]:
        """Parity chi-square (3 degrees of freedom) of each row."""
        return (self.offset**2 / self.scale**2).sum(-1)

    def log_parity(self, used: Bool[Tensor, " r"]) -> Float[Tensor, " c"]:
        """Log density of the wrenches that were read, given the poses that were read, over the
        rows in use. Beyond the limit it falls with the logarithm of the distance."""
        square = self.chi_square
        growth = (square / PARITY_LIMIT).clamp_min(1.0)
        each = -0.5 * square / growth - 1.5 * growth.log() - self.scale.log().sum(-1)
        each = each - 1.5 * math.log(2 * math.pi) - self.log_units
        return each[:, used].sum(-1)

    def standard_parity(
        self, read: Bool[Tensor, " r"]
    ) -> tuple[Float[Tensor, "c r 3"], Float[Tensor, "c r 3"]]:
        """Parity residuals in standard units, at most at the limit, and the logarithms of the
        units; zero for rows that take no part. Their density is that of `log_parity`."""
        growth = (self.chi_square / PARITY_LIMIT).clamp_min(1.0).sqrt()
        scale = self.scale * growth[..., None]
        units = scale.log() + self.log_units[..., None] / 3
        here = read[:, None]
        return torch.where(here, self.offset / scale, 0.0), torch.where(here, units, 0.0)


def merge(
    readings: Float[Tensor, "r 6"], variance: Float[Tensor, " 6"], conditions: Conditions
) -> Merged:
    """Merge measured poses and wrenches, whose noise has the `variance`, row by row."""
    poses, wrenches = readings[:, :3], readings[:, 3:]
    stiffness = conditions.stiffness
    unread = torch.linalg.inv(conditions.sensor)
    true = (unread @ (wrenches - conditions.bias)[..., None])[..., 0]
    offset = angle_difference(true / stiffness + conditions.command, poses)
    pose_variance = variance[:3]
    wrench_variance = (unread**2 @ variance[3:, None])[..., 0] / stiffness**2
    weight = pose_variance / (pose_variance + wrench_variance)
    # Either sensor may be at fault; a bad row is kept with a variance that covers both.
    total = pose_variance + wrench_variance
    bad = (offset**2 / total).sum(-1, keepdim=True) > PARITY_LIMIT
    merged = weight * wrench_variance + torch.where(bad, offset**2, 0.0)
    units = stiffness.log().sum(-1) + torch.linalg.slogdet(conditions.sensor).logabsdet
    return Merged(
        poses=poses + weight * offset,
        variance=merged,
        offset=offset,
        scale=total.sqrt().expand_as(offset),
        log_units=units.expand(offset.shape[:2]),
    )


@dataclass(frozen=True)
class Setting:
    """What m particles hold a history to be: conditions, or those that all share, and poses."""

    conditions: Conditions
    merged: Merged
    used: Bool[Tensor, " n"]
    """Transitions that count; the others part the history."""
    angles: Float[Tensor, " n"]
    """Angles of the object that tell which bumps of the misfit act [rad]: of the readings without
    effects, the same for all particles."""

    @property
    def highest_terms(self) -> Float[Tensor, "c n"]:
        """What the log density of each transition's residual cannot exceed, whatever theta is."""
        terms = -0.5 * (2 * math.pi * self.merged.variance[:, 1:]).log().sum(-1)
        return torch.where(self.used, terms, 0.0)

    def __getitem__(self, index: Tensor) -> Setting:
        """Of some particles."""

        def pick(part: Conditions | Merged) -> dict[str, Tensor]:
            return {n: v if len(v) == 1 else v[index] for n, v in vars(part).items()}

        conditions, merged = Conditions(**pick(self.conditions)), Merged(**pick(self.merged))
        return Setting(conditions, merged, self.used, self.angles)
