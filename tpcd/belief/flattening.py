"""Coordinates in which the sheet on which theta is likely lies flat.

A reading in contact says that the outline touched a terrain at a pose that is known to a fraction
of a millimetre; a contact that stuck says how far from the terrain the hand was when it turned; one
that slid what the friction was. With the normal n and the direction u along terrain t, its offset
o_t, poses (x_k, phi_k) of the hand, the mount (m, phi_m) and the force f:

    touch:    n x_k + n R(phi_k) m + scale min_p n R(phi_k + phi_m) p = o_t
    rolling:  u (x_k - x_j) + (phi_k - phi_j) (n (x_k + x_j) / 2 - o_t) = 0
    sliding:  |u f| = friction n f

For a given outline p, angle phi_m and size of the misfit, these are linear in scale, m, friction,
floor and wall. Together with the prior's mean and variance they say that these six are normal, with
mean b and precision L L^T that depend on the rest. The flat coordinates are the scores of the rest,
and e = L^T (six - b), which is nearly standard normal wherever the rest is, while the scores of the
six follow the rest in a thin and bent sheet. This is a triangular map (Parno and Marzouk 2018):
what it leaves out (torque, effects, a contact that is taken for another) costs draws, and never
makes an answer wrong, since densities are carried over with its Jacobian.

Axes: m points, d scores (theta's and, last, that of the misfit's size), c touches, r rows of
rolling and sliding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.belief.box import nearest_inside
from tpcd.belief.contact_rows import (
    LINEAR,
    offset_signs,
    rolling_rows,
    sliding_rows,
    terrain_normals,
)
from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.weights import finite
from tpcd.planar import rotate
from tpcd.threads import over_threads

INSIDE = 0.02
"""How far inside the box the likeliest six are, as a share of its widths: at the edge, scores are
infinite."""
FAR_OFF = 3.0
"""Mean deviations that points may be off a row."""
LARGEST_MISFIT = 0.1
"""The map takes no misfit to be larger [m]: beyond, nothing is left of the readings anyway."""
_OUTLINES_AT_ONCE = 128
"""Outlines whose points are measured along all normals at once, in fast memory: 64 to 512 take
half of the time of 1500."""
_TOUCHES_AT_ONCE = 30_000
"""Points times touches that are held in memory at once, for all points of an outline."""


@dataclass(frozen=True, eq=False)
class Flattening:
    """The map between scores and flat coordinates, for one history."""

    prior: ParameterPrior
    misfit: MisfitField
    normals: Float[Tensor, "c 2"]
    """Of the terrains that were touched."""
    terrains: Int[Tensor, " c"]
    """0 for the floor, 1 for the wall."""
    poses: Float[Tensor, "c 3"]
    """Of the hand at each touch, estimated [m, m, rad]."""
    variance: Float[Tensor, " c"]
    """Of their place along the normal [m^2]."""
    rows: Float[Tensor, "r 6"]
    """Coefficients of the six in rolling and sliding, in units of their deviations."""
    values: Float[Tensor, " r"]
    """Right sides of the same."""

    def consistent(self, score: Float[Tensor, "m d"], weights: Float[Tensor, " m"]) -> Flattening:
        """The same without the touches and rows that weighted points contradict: how a step ended
        does not tell how it went."""
        vector = self.prior.to_vector(score[:, :-1])
        six = vector[:, self.entries]
        kept = weights @ (six @ self.rows.mT - self.values).abs() < FAR_OFF
        design, aim = self._touches(vector)
        off = (design @ six[..., None])[..., 0] - aim
        of_outline = self._misfit_sd(score)[:, None] ** 2 * (1 + self.misfit.grain**2)
        sd = (self.variance + of_outline).sqrt()
        met = weights @ (off / sd).abs() < FAR_OFF
        return replace(
            self,
            rows=self.rows[kept],
            values=self.values[kept],
            normals=self.normals[met],
            terrains=self.terrains[met],
            poses=self.poses[met],
            variance=self.variance[met],
        )

    def to_score(
        self, flat: Float[Tensor, "m d"]
    ) -> tuple[Float[Tensor, "m d"], Float[Tensor, " m"]]:
        """Scores, and log |d score / d flat|; entries outside their box are infinite."""
        linear = self.entries
        low, width = self._box
        mean, factor, _ = self._conditional(flat)
        step = torch.linalg.solve_triangular(factor.mT, flat[:, linear, None], upper=True)
        place = (mean + step[..., 0] - low) / width
        score = flat.clone()
        score[:, linear] = torch.special.ndtri(place.clamp(0.0, 1.0))
        return score, self._log_slope(score, factor)

    def from_score(
        self, score: Float[Tensor, "m d"]
    ) -> tuple[Float[Tensor, "m d"], Float[Tensor, " m"]]:
        """Flat coordinates, and log |d score / d flat|."""
        linear = self.entries
        mean, factor, _ = self._conditional(score)
        away = self.prior.to_vector(score[:, :-1])[:, linear] - mean
        flat = score.clone()
        flat[:, linear] = (factor.mT @ away[..., None])[..., 0]
        return flat, self._log_slope(score, factor)

    @property
    def entries(self) -> list[int]:
        """Which coordinates are nearly standard normal, whatever the others are."""
        return [self.prior.names.index(name) for name in LINEAR]

    @property
    def _box(self) -> tuple[Tensor, Tensor]:
        low, high = (edge[self.entries] for edge in (self.prior.low, self.prior.high))
        return low, high - low

    def _log_slope(self, score: Tensor, factor: Tensor) -> Tensor:
        """The six are mean + factor^-T e, and places in the box, of which scores are normal."""
        normal = -0.5 * score[:, self.entries] ** 2 - 0.5 * math.log(2 * math.pi)
        width = self._box[1]
        return -_log_diagonal(factor) - (normal + width.log()).sum(-1)

    def log_marginal(self, flat: Float[Tensor, "m d"]) -> Float[Tensor, " m"]:
        """How likely the rest is by what the readings say about the six, but for a constant."""
        return self._conditional(flat)[2]

    def likeliest(
        self, flat: Float[Tensor, "m d"]
    ) -> tuple[Float[Tensor, "m d"], Float[Tensor, " m"]]:
        """Scores of the rest with the six inside their box that are likeliest by the readings and
        the prior, taken for a normal, and how likely they are, but for a constant."""
        mean, factor, marginal = self._conditional(flat)
        low, width = self._box
        precision = (factor @ factor.mT) * width[:, None] * width
        place, cost = nearest_inside((mean - low) / width, precision, INSIDE)
        score = flat.clone()
        score[:, self.entries] = torch.special.ndtri(place)
        return score, finite(marginal - cost)

    def _conditional(self, score: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (m, 6) of the six given the rest, the Cholesky factor of their precision, and the
        log likelihood of the rest."""
        at_once = max(1, _TOUCHES_AT_ONCE // max(1, len(self.poses)))
        parts = over_threads(self._conditional_part, score, at_once)
        mean, factor, marginal = (torch.cat(column) for column in zip(*parts, strict=True))
        return mean, factor, marginal

    def _conditional_part(self, score: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        low, width = self._box
        rest = score.clone()
        rest[:, self.entries] = 0.0
        vector = self.prior.to_vector(rest[:, :-1])
        sd = self._misfit_sd(score)
        count = len(score)
        # The prior, as if it were normal.
        weight = 12.0 / width**2
        precision = torch.diag(weight).expand(count, 6, 6)
        pull = (weight * (low + 0.5 * width)).expand(count, 6)
        marginal = torch.zeros_like(sd)
        if len(self.poses):
            design, aim = self._touches(vector)
            whiten, spread = self._misfit_axes
            scale = (1 + sd[:, None] ** 2 * spread).rsqrt()
            design = scale[..., None] * (whiten @ design)
            aim = scale * (whiten @ aim)
            precision = precision + design.mT @ design
            pull = pull + (design.mT @ aim[..., None])[..., 0]
            marginal = scale.log().sum(-1) - 0.5 * aim.square().sum(-1)
        precision = precision + self.rows.mT @ self.rows
        pull = pull + self.values @ self.rows
        factor = torch.linalg.cholesky(precision)
        half = torch.linalg.solve_triangular(factor, pull[..., None], upper=False)
        mean = torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0]
        marginal = marginal + 0.5 * half.square().sum((-2, -1)) - _log_diagonal(factor)
        return mean, factor, marginal

    def _touches(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients (m, c, 6) of the six at each touch, and right sides (c)."""
        parameters = self.prior.parameters_of(vector)
        points = self.prior.shape.boundary_points(parameters.latent).double()
        angle = self.poses[:, 2] + parameters.mount[:, 2:]
        turned = rotate(-angle, self.normals)
        parts = zip(turned.split(_OUTLINES_AT_ONCE), points.split(_OUTLINES_AT_ONCE), strict=True)
        support = torch.cat([(normals @ outlines.mT).amin(-1) for normals, outlines in parts])
        along = rotate(-self.poses[:, 2], self.normals)
        offset = offset_signs(self.terrains, along)
        fixed = torch.cat((along, torch.zeros_like(along[:, :1]), -offset), dim=-1)
        fixed = fixed.expand(len(vector), -1, -1)
        aim = -(self.normals * self.poses[:, :2]).sum(-1)
        return torch.cat((support[..., None], fixed), dim=-1), aim

    def _misfit_sd(self, score: Tensor) -> Tensor:
        return self.misfit.sd_of(score[:, -1]).clamp_max(LARGEST_MISFIT)

    @property
    def _misfit_axes(self) -> tuple[Tensor, Tensor]:
        """A matrix W (c, c) and numbers v (c), with which W times what touches are off by has the
        covariance 1 + sd^2 diag(v): what a reading is off by and what the outline is."""
        angle, unit = self.poses[:, 2], self.variance.rsqrt()
        near = torch.exp(-((angle[:, None] - angle) ** 2) / (4 * self.misfit.width**2))
        near = near * (self.terrains[:, None] == self.terrains)
        near = near + self.misfit.grain**2 * torch.eye(len(angle), dtype=near.dtype)
        values, axes = torch.linalg.eigh(unit[:, None] * near * unit)
        return axes.mT * unit, values.clamp_min(0.0)


def _log_diagonal(factor: Tensor) -> Tensor:
    """Log of the root of a determinant, from its Cholesky factor."""
    return factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def flattening(
    prior: ParameterPrior,
    misfit: MisfitField,
    history: History,
    touched: Bool[Tensor, "n t"],
    stuck: Bool[Tensor, "n t"],
) -> Flattening:
    """The map for a history in which transitions ended on terrains, and stuck there."""
    touched = touched & history.used[:, None]
    row, terrain = torch.nonzero(touched, as_tuple=True)
    normal = terrain_normals(history)[terrain]
    rolling, sliding = rolling_rows(history, touched, stuck), sliding_rows(history, touched, stuck)
    rows, values = (torch.cat(parts) for parts in zip(rolling, sliding, strict=True))
    return Flattening(
        prior=prior,
        misfit=misfit,
        normals=normal,
        terrains=terrain,
        poses=history.settled[row],
        variance=(history.variance[1:][row, :2] * normal**2).sum(-1),
        rows=rows,
        values=values,
    )
