"""What a recording says that begins in free space: floor and wall are not where the object is.

A transition takes its start pose as given, and puts an object that would overlap the floor
onto it before it sets out. So the likelihood of transitions cannot tell that the arm rested at
its command, without load, where theta lets the object reach into the floor. The start was
chosen without regard to theta, apart from being free; given theta and all that the data tell of
the outline's misfit, it is free with the probability that misfit and noise leave a gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.misfit import MisfitField
from tpcd.belief.setting import PARITY_LIMIT, Setting
from tpcd.effects.conditions import angle_difference
from tpcd.planar import perpendicular, rotate


def rests_free(history: History) -> Bool[Tensor, " rows"]:
    """Whether the arm rests where it was commanded, as far as noise tells."""
    offset = angle_difference(history.poses, history.commands)
    return (offset**2 / history.variance).sum(-1) < PARITY_LIMIT


def free_starts(history: History) -> Int[Tensor, " f"]:
    """Rows with which a recording begins at rest where it was commanded, if what follows counts."""
    first = torch.ones_like(history.used)
    first[1:] = history.seams[:-1]
    return torch.nonzero(first & history.used & rests_free(history)[:-1]).flatten()


@dataclass(frozen=True)
class StartGaps:
    """Gaps of the outlines of m particles to t terrains at f rows, without misfit."""

    gap: Float[Tensor, "m f t"]
    """Of the nearest point [m]; below zero where it is inside of the terrain."""
    variance: Float[Tensor, "m f t"]
    """What the noise of the pose makes of it [m^2]."""
    angle: Float[Tensor, " f"]
    """Angle of the object that tells which bumps of the misfit act [rad]."""

    def log_free(
        self,
        field: MisfitField,
        sd: Float[Tensor, " m"],
        mean: Float[Tensor, "m c"],
        covariance: Float[Tensor, "m c c"],
    ) -> Float[Tensor, " m"]:
        """Log probability that nothing is touched, with what is known of the field; -inf for a
        particle that is not finite.

        Starts of several recordings are much alike, and so is the misfit there: the least
        likely one counts for all.
        """
        gap, variance = self.gap, self.variance
        if field.bumps:
            gap = gap + field.gap(mean[:, None], self.angle)
            variance = variance + field.gap_variance(covariance, sd, self.angle)
        return _log_free(gap, variance)

    def log_free_before(self, field: MisfitField, sd: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """The same before any data: no more than that can all of them together be likely."""
        variance = self.variance
        if field.bumps:
            known, _ = field.basis(self.angle)
            of_field = (known**2).sum(-1) + field.uncovered(known)
            variance = variance + (sd**2)[:, None, None] * of_field[:, None]
        return _log_free(self.gap, variance)


def _log_free(gap: Tensor, variance: Tensor) -> Tensor:
    """Log probability (m) that gaps (m, f, t) of a variance (m, f, t) [m, m^2] are open; the least
    likely row f counts."""
    total = torch.special.log_ndtr(gap / variance.sqrt()).amin(-2).sum(-1)
    return torch.where(torch.isfinite(total), total, -torch.inf)


def start_gaps(
    points_ee: Float[Tensor, "m p 2"],
    setting: Setting,
    angles: Float[Tensor, " r"],
    rows: Int[Tensor, " f"],
) -> StartGaps:
    """Gaps at some rows, whose measured poses have the `angles`."""
    conditions, merged = setting.conditions, setting.merged
    normal, offset, turn = (
        value if value.shape[1] == 1 else value[:, rows]
        for value in (conditions.normal, conditions.offset, conditions.turn)
    )
    pose, variance = merged.poses[:, rows], merged.variance[:, rows]
    m, f, t = len(points_ee), len(rows), offset.shape[-1]
    towards = rotate(-(pose[..., 2:] + turn), normal).expand(m, f, t, 2).flatten(1, 2)
    lowest, index = torch.bmm(towards, points_ee.mT).min(-1)
    point = points_ee.gather(1, index[..., None].expand(-1, -1, 2))
    lever = (towards * perpendicular(point)).sum(-1).unflatten(1, (f, t))
    noise = (normal**2 * variance[:, :, None, :2]).sum(-1) + lever**2 * variance[..., 2:]
    gap = lowest.unflatten(1, (f, t)) + (normal * pose[:, :, None, :2]).sum(-1) - offset
    return StartGaps(gap, noise, angles[rows])
