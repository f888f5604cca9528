"""What a recording says that begins in free space: floor and wall are not where the object is.

A transition takes its start pose as given, and puts an object that would overlap the floor
onto it before it sets out. So the likelihood of transitions cannot tell that the arm rested at
its command, without load, where theta lets the object reach into the floor. The start was
chosen without regard to theta, apart from being free; given theta, it is free with the
probability that the outline's misfit and the noise of the pose leave a gap everywhere.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.setting import PARITY_LIMIT, Setting
from tpcd.contact import terrain_gaps
from tpcd.effects.conditions import angle_difference


def free_starts(history: History) -> Int[Tensor, " f"]:
    """Rows with which a recording begins at rest where it was commanded, if what follows counts."""
    first = torch.ones_like(history.used)
    first[1:] = history.seams[:-1]
    offset = angle_difference(history.start, history.previous)
    square = (offset**2 / history.variance[:-1]).sum(-1)
    return torch.nonzero(first & history.used & (square < PARITY_LIMIT)).flatten()


def log_free(
    points_ee: Float[Tensor, "m p 2"],
    setting: Setting,
    misfit_sd: Float[Tensor, " m"],
    rows: Int[Tensor, " f"],
) -> Float[Tensor, " m"]:
    """Log probability that the object touches nothing at the rows, whose poses are measured.

    -inf for a particle that is not finite.
    """
    conditions, merged = setting.conditions, setting.merged
    scene = conditions.scene(points_ee[:, None])
    if scene.batch_shape[1] > 1:
        scene = scene.columns(rows)
    turn, normal = (_at(value, rows) for value in (conditions.turn, conditions.normal))
    turned = torch.cat((torch.zeros_like(turn), torch.zeros_like(turn), turn), dim=-1)
    variance = merged.variance[:, rows]
    gaps, levers = terrain_gaps(scene.points_ee, scene.terrains, merged.poses[:, rows] + turned)
    gap, lowest = gaps.min(-1)
    lever = levers.gather(-1, lowest[..., None])[..., 0]
    noise = (normal**2 * variance[:, :, None, :2]).sum(-1) + lever**2 * variance[..., 2:]
    each = torch.special.log_ndtr(gap / (noise + misfit_sd[:, None, None] ** 2).sqrt())
    total = each.sum((-1, -2))
    return torch.where(torch.isfinite(total), total, -torch.inf)


def _at(value: Tensor, rows: Tensor) -> Tensor:
    """The value (m, r, ...) at some rows; r may be 1."""
    return value if value.shape[1] == 1 else value[:, rows]
