"""The misfit of the shape prior as a random field along the outline, marginalised exactly.

No outline of the prior is the true one. Seen from a flat terrain, an outline error is a
change of the gap that depends on the angle of the object: eps_t(angle), one smooth function
for each terrain, with variance sd^2 and correlation exp(-(a - b)^2 / (4 width^2)). Its
slope moves the contact point along the terrain, which changes the lever of the force. What
of both is not known acts linearly on the settled pose, so for given theta the field is a
linear-Gaussian model: it is integrated out of the likelihood in closed form, learnt from the
same data, and its posterior corrects and widens predictions (Rao-Blackwellisation). What is
known moves the terrains themselves: contact begins where the field says.

eps_t(angle) = sum_j b_j(angle) c_tj, with c ~ N(0, sd^2) and Gaussian bumps b_j.

Outline errors need not be that smooth: on a nearly flat face a tenth of a millimetre can move
the contact point by centimetres within a few milliradians. So at each reading the gap and its
slope have errors of their own besides (`grain` and `roughness`), anew also where the object has
not moved; nothing is learnt of them but how large they are together with the field.

How far the true outline is from the best one of the prior differs by a factor of ten from
object to object, so sd is itself unknown: log-normal around what the prior misses on outlines
inside and outside of its training, and learnt as one more entry of every particle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.simulator import Transition


@dataclass(frozen=True)
class MisfitField:
    """Bumps on a grid of angles, spaced by their width, and the prior of their size."""

    sd: float
    """Median of the standard deviation of the outline error [m]; 0 switches the field off."""
    spread: float = 0.0
    """Standard deviation of the logarithm of that standard deviation; 0 makes it known."""
    width: float = 0.15
    """Width and spacing of the bumps [rad]: how far the object turns until the error is another."""
    reach: float = 0.45
    """The outermost bumps lie at the multiple of the width nearest to +-reach [rad]; beyond, the
    error is independent noise."""
    grain: float = 0.0
    """Standard deviation of what each reading's gap has besides, as a share of the field's."""
    roughness: float = 0.0
    """The same of the slope [1/rad]."""

    def __post_init__(self) -> None:
        """Refuse a field without meaning."""
        positive = (self.sd, self.spread, self.reach, self.grain, self.roughness)
        if min(positive) < 0 or self.width <= 0:
            raise ValueError(
                f"misfit sd {self.sd}, spread {self.spread}, reach {self.reach}, grain {self.grain}"
                f" and roughness {self.roughness} must be >= 0 and width {self.width} > 0"
            )

    @property
    def bumps(self) -> int:
        """Number of bumps for each terrain; none where the field is switched off."""
        if self.sd == 0:
            return 0
        return 2 * max(1, round(self.reach / self.width)) + 1

    def sd_of(self, score: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Standard deviation of the outline error [m] from a standard normal score."""
        return self.sd * torch.exp(self.spread * score)

    def gap(
        self, coefficients: Float[Tensor, "*#batch c"], angle: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch t"]:
        """The field's change of the gap to each of t terrains [m], for c = t x j coefficients."""
        each = coefficients.unflatten(-1, (-1, self.bumps))
        return (each * self.basis(angle)[0][..., None, :]).sum(-1)

    def gap_variance(
        self,
        covariance: Float[Tensor, "m c c"],
        sd: Float[Tensor, " m"],
        angle: Float[Tensor, " n"],
    ) -> Float[Tensor, "m n t"]:
        """Variance of the gap to each of t terrains [m^2] at n angles, for coefficients of a
        `covariance` [m^2] and a misfit of standard deviation `sd` [m]."""
        value, _ = self.basis(angle)
        t = covariance.shape[-1] // self.bumps
        blocks = covariance.unflatten(-1, (t, -1)).unflatten(1, (t, -1))
        own = blocks.diagonal(dim1=1, dim2=3)
        known = torch.einsum("na,mabt,nb->mnt", value, own, value)
        return known + (sd**2)[:, None, None] * self.uncovered(value)[:, None]

    def uncovered(self, value: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch"]:
        """Variance of a gap, in units of sd^2, that bumps of these values leave to each reading."""
        return (1 - (value**2).sum(-1)).clamp_min(0.0) + self.grain**2

    def basis(
        self, angle: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch j"], Float[Tensor, "*batch j"]]:
        """Values and derivatives [1/rad] of the bumps at the angles of the object [rad]."""
        place = torch.arange(self.bumps, dtype=angle.dtype, device=angle.device)
        nodes = self.width * (place - (self.bumps - 1) / 2)
        distance = (angle[..., None] - nodes) / self.width
        # On a lattice spaced by the width, the squared bumps sum to sqrt(pi).
        value = torch.exp(-0.5 * distance**2) * math.pi**-0.25
        return value, -distance / self.width * value


def misfit_rows(
    field: MisfitField,
    sd: Float[Tensor, "*#batch"],
    angle: Float[Tensor, "*#batch"],
    transition: Transition,
) -> tuple[Float[Tensor, "*batch 3 c"], Float[Tensor, "*batch 3 3"]]:
    """How the settled pose answers the field: rows H with pose = model + H c, and the
    covariance of what each reading's outline has besides. c = t x j coefficients."""
    value, slope = field.basis(angle)
    gap, lever = transition.pose_from_gap, transition.pose_from_lever
    rows = gap[..., None] * value[..., None, None, :] + lever[..., None] * slope[..., None, None, :]
    rows = rows.transpose(-3, -2).flatten(-2)
    own = (sd**2 * field.uncovered(value))[..., None, None]
    steep = (sd**2 * field.roughness**2)[..., None, None]
    return rows, own * (gap.mT @ gap) + steep * (lever.mT @ lever)
