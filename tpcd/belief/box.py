"""The likeliest places in a unit box, of normal densities whose means may lie outside.

Axes: m densities, d entries. Each is a contact problem (`tpcd.qp`) with the sides of the box as
its one-sided rows.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.qp import ContactQP, Status, solve


def nearest_inside(
    mean: Float[Tensor, "m d"], precision: Float[Tensor, "m d d"], margin: float
) -> tuple[Float[Tensor, "m d"], Float[Tensor, " m"]]:
    """Where normal densities are largest in a unit box, no nearer to its sides than `margin`, and
    how far their logarithms there are below those at their means.

    Where one is not to be found (no mean, or no precision) it is the middle, infinitely below.
    """
    m, d = mean.shape
    identity = torch.eye(d, dtype=mean.dtype, device=mean.device)
    sides = torch.cat((identity, -identity)).expand(m, -1, -1)
    offsets = mean.new_tensor([-margin, 1.0 - margin]).repeat_interleave(d).expand(m, -1)
    found = solve(ContactQP(precision, mean, sides, offsets))
    away = found.motion - mean
    below = 0.5 * (away * (precision @ away[..., None])[..., 0]).sum(-1)
    solved = found.status == int(Status.SOLVED)
    place = torch.where(solved[:, None], found.motion, 0.5)
    return place, torch.where(solved, below, torch.inf)
