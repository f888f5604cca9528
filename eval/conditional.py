"""Places of true entries given all others: a check of the likelihood without a sampler.

If theta and the misfit are drawn from the prior and the data given both, each entry is a draw from
its posterior given the data *and the true values of all others*. That posterior lives on a line,
where it is integrated by brute force, so places that are not uniform blame the likelihood (or the
episodes) alone.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Target
from tpcd.belief.modes import log_target

NEAREST, FURTHEST = 1e-4, 6.0
"""Distances from the truth, in standard deviations of the prior, between which the line is read."""
POINTS = 80
"""Points to either side, at distances that grow by the same factor: given all others, entries are
known to between 1 and 0.003 standard deviations of the prior."""


def conditional_places(target: Target, truth: Float[Tensor, " d"]) -> Float[Tensor, " d"]:
    """P(entry < true entry | data, all other true entries) for each entry of a true score.

    Raises ValueError where the likelihood is zero all along a line.
    """
    exponents = torch.linspace(0, 1, POINTS, dtype=truth.dtype)
    away = NEAREST * (FURTHEST / NEAREST) ** exponents
    offsets = torch.cat((-away.flip(0), away.new_zeros(1), away))
    moves = torch.diag_embed(offsets[:, None].expand(-1, len(truth)))
    log_density = log_target(target, (truth + moves).flatten(0, 1)).unflatten(0, (len(offsets), -1))
    highest = log_density.amax(0)
    if not bool(torch.isfinite(highest).all()):
        raise ValueError("the likelihood is zero at the truth and all along a line through it")
    density = (log_density - highest).exp()
    mass = 0.5 * (density[1:] + density[:-1]) * offsets.diff()[:, None]
    return mass[:POINTS].sum(0) / mass.sum(0)
