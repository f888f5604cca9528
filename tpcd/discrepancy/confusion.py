"""Which effects the data could not tell apart: what each does to them beyond theta.

The signature of an effect is the change of all innovations when its parameter leaves its null
value, less what a change of theta could undo (projection with the prior as a ridge). Where the
signature of one effect lies in the span of another's, no amount of search can decide between
the two on these data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.carrying import carried
from tpcd.discrepancy.diagnosis import Confusion
from tpcd.discrepancy.fit import Fit, Question, fit_stream
from tpcd.effects.protocol import Effect, EffectParameter

ALIKE = 0.95
"""Cosine from which two effects are not told apart: the second explains nine tenths of what the
first one gains."""
SHARES = (0.1, 0.2, 0.4, 0.8)
"""Changes of a parameter, relative to the width of its prior; signatures are of the first."""
FAINT = 2.0
"""An effect that changes innovations by less than this is changed by more."""
Reach = tuple[tuple[float, float], ...]
"""Sizes of a parameter, in SI units, and how far they move all innovations together."""
_DIFFERENCE = 0.02
"""Change of an entry of theta, in standard deviations of its prior."""


def signatures(
    question: Question, base: Fit, effects: Sequence[Effect], share: float = SHARES[0]
) -> dict[str, Float[Tensor, "k r"]]:
    """For each effect what its k parameters do to all r innovations, beyond theta, where they leave
    their null value by a share of their prior."""
    here = base.cloud.positions[base.cloud.weights.argmax()][None]
    target = ContactTarget(base.prior, question.misfit, base.step, question.history)
    steps = torch.diag(here.new_full((here.shape[-1],), _DIFFERENCE))
    found = _innovations(target, torch.cat((here, here + steps)))
    slopes = (found[1:] - found[0]) / _DIFFERENCE
    return {e.name: _beyond(_changes(question, base, e, share), slopes) for e in effects}


def reach_of(
    question: Question, base: Fit, effect: Effect, signature: Float[Tensor, "k r"]
) -> tuple[Reach, ...]:
    """How far all innovations together change by each parameter of an effect, at the first of
    `SHARES` and, where that is faint for any of them, at the others."""
    norms = {SHARES[0]: signature.norm(dim=1).tolist()}
    if min(norms[SHARES[0]]) < FAINT:
        for share in SHARES[1:]:
            norms[share] = (
                signatures(question, base, [effect], share)[effect.name].norm(dim=1).tolist()
            )
    return tuple(
        tuple((abs(_way(parameter, share)), norms[share][k]) for share in norms)
        for k, parameter in enumerate(effect.parameters)
    )


def confusions(found: Mapping[str, Float[Tensor, "k r"]]) -> list[Confusion]:
    """Pairs that are not told apart, the most alike first; a pair may stand there both ways."""
    pairs = []
    spans = {name: _span(rows) for name, rows in found.items()}
    for name, rows in found.items():
        own = rows[0]
        length = float(own.norm())
        for other, span in spans.items():
            if other == name or length < 1.0:
                continue
            likeness = float((span @ own).norm()) / length
            if likeness > ALIKE:
                pairs.append(Confusion(name, other, likeness))
    return sorted(pairs, key=lambda pair: -pair.likeness)


def _changes(question: Question, base: Fit, effect: Effect, share: float) -> Float[Tensor, "k r"]:
    """Change of the innovations when each parameter leaves its null value by a share of its prior,
    but stays within that."""
    effects = (*base.effects, effect)
    prior = question.scene.with_effects(effects)
    target = ContactTarget(prior, question.misfit, base.step, question.history)
    null = carried(base, prior, fit_stream(question, effects, 0), 1)
    places = [null[0]]
    first = prior.dimension - len(effect.parameters)
    vector = prior.to_vector(null[0, :-1])
    for k, parameter in enumerate(effect.parameters):
        moved = vector.clone()
        moved[first + k] = parameter.null + _way(parameter, share)
        places.append(torch.cat((prior.to_score(moved), null[0, -1:])))
    found = _innovations(target, torch.stack(places))
    return found[1:] - found[0]


def _way(parameter: EffectParameter, share: float) -> float:
    """From the null value to a share of the prior further, or to its end."""
    up, down = parameter.high - parameter.null, parameter.null - parameter.low
    way = share * (parameter.high - parameter.low)
    return min(way, up) if up >= down else -min(way, down)


def _innovations(target: ContactTarget, score: Tensor) -> Float[Tensor, "m r"]:
    found = target.evaluate(score, innovations=True)
    assert found.whitened is not None
    parity, _ = target.parity(score)
    return torch.cat((found.whitened.nan_to_num(0.0).flatten(1), parity.flatten(1)), dim=1)


def _beyond(changes: Float[Tensor, "k r"], slopes: Float[Tensor, "s q"]) -> Float[Tensor, "k r"]:
    """What of the changes theta cannot undo, whose prior has unit variance; it moves the first q
    innovations only, since parity does not depend on it."""
    short = changes.shape[-1] - slopes.shape[-1]
    slopes = torch.nn.functional.pad(slopes, (0, short))
    information = slopes @ slopes.T + torch.eye(len(slopes), dtype=slopes.dtype)
    return changes - (changes @ slopes.T) @ torch.linalg.solve(information, slopes)


def _span(rows: Float[Tensor, "k r"]) -> Float[Tensor, "j r"]:
    """An orthonormal basis of what the rows span, without directions that are noise."""
    _, size, basis = torch.linalg.svd(rows, full_matrices=False)
    return basis[size > 0.05 * size.max().clamp_min(1e-12)]
