"""Places of one model's posterior in the coordinates of another model."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.prior import ParameterPrior
from tpcd.discrepancy.fit import Fit

_REMEMBERED = 12
"""Places of an earlier fit that a new one starts from as well."""
_WITHIN = 2.5
"""A null value at the end of a prior is started from within so many standard scores."""


def carried(
    fit: Fit,
    prior: ParameterPrior,
    generator: torch.Generator,
    count: int = _REMEMBERED,
    repeat: bool = False,
) -> Float[Tensor, "k s"]:
    """At most `count` places of a fit in the coordinates of another model, with `repeat` so many
    in any case: effects that both have are kept, new ones start at their null value and at draws
    from their prior."""
    best = fit.cloud.weights.argsort(descending=True)[:count]
    if repeat:  # two in a row, so that both kinds of start are made of each
        best = best[(torch.arange(count) // 2) % len(best)]
    places = fit.cloud.positions[best]
    scene = prior.scene_dimension
    columns = [_rescaled(places[:, :scene], fit.prior, prior)]
    own = dict(zip(fit.prior.names[scene:], places[:, scene:-1].T, strict=True))
    null = torch.cat((prior.low[:scene], _null(prior)))
    null_score = prior.to_score(null)[scene:].clamp(-_WITHIN, _WITHIN)
    for k, name in enumerate(prior.names[scene:]):
        drawn = torch.randn(len(places), generator=generator, dtype=torch.float64)
        drawn[::2] = null_score[k]
        columns.append(own.get(name, drawn)[:, None])
    return torch.cat((*columns, places[:, -1:]), dim=-1)


def _rescaled(
    score: Float[Tensor, "k d"], before: ParameterPrior, now: ParameterPrior
) -> Float[Tensor, "k d"]:
    """Coordinates of the scene where the prior of some entries is another one."""
    scene = slice(0, score.shape[-1])
    (low, high), (least, most) = ((p.low[scene], p.high[scene]) for p in (before, now))
    if torch.equal(low, least) and torch.equal(high, most):
        return score
    place = low + (high - low) * torch.special.ndtr(score)
    share = ((place - least) / (most - least)).clamp(1e-9, 1 - 1e-9)
    return torch.where((low == least) & (high == most), score, torch.special.ndtri(share))


def _null(prior: ParameterPrior) -> Tensor:
    values = [p.null for effect in prior.effects for p in effect.parameters]
    return torch.tensor(values, dtype=torch.float64)
