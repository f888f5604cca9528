"""Formulas in place of effects: a law that the catalogue lacks, of which an effect takes a part.

Friction that grows along the floor is another friction on the wall too, so that an effect is
accepted, and may leave too little for anybody to ask on. Formulas are therefore also asked to
explain the data instead of the effects at their site, one by one and together, and where
something is left any formula instead of all effects. Each effect has to gain the least that it is
accepted for, and a formula, which is less likely beforehand, more (`Workbench.price`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.pruning import pruned
from tpcd.discrepancy.screening import Glance, glance
from tpcd.discrepancy.settings import (
    AMBIGUOUS,
    FRESH,
    NEARLY_OUTDONE,
    RIVAL_SEEDS,
    RIVAL_WITHIN,
)
from tpcd.discrepancy.workbench import (
    Close,
    Round,
    Workbench,
    each_of,
    gave_way,
    looked_closer,
    takes_the_place,
)
from tpcd.effects.protocol import Effect

FULL_FITS = 2
"""Formulas that are fitted in full where the effects leave something, whatever the quick look
says: with effects that are not there, the scene may have gone astray."""


@dataclass(frozen=True)
class _Rival:
    """A formula, beside what is left without the effects that it stands for."""

    seen: Glance
    without: Fit
    instead_of: tuple[Effect, ...]
    price: float
    """How much more it has to explain than the model with those effects."""

    @property
    def formula(self) -> Effect:
        """What takes their place."""
        return self.seen.effect

    @property
    def worth(self) -> float:
        """What the quick look sees beyond the price."""
        return self.seen.log_evidence - self.price


def outdone(bench: Workbench, base: Fit, current: Fit, explained: bool) -> Round:
    """The model with a formula in place of effects, where one explains the data so much better.

    `base` is the model without effects of its own; `explained` says whether the current model
    leaves nothing. A round's base is the current model, perhaps better fitted.
    """
    fits = []
    for rival in _chosen(bench, base, current, explained):
        fits += each_of(
            bench, [rival.formula], _number(bench, rival), _fit_of(bench, current, rival)
        )
    fits = [one for one in fits if math.isfinite(one[1].log_evidence)]
    best = max(fits, key=lambda one: one[1].log_evidence - one[0].price, default=None)
    if best is None:
        return Round(current)
    rival, fit = best
    if fit.log_evidence - rival.price > current.log_evidence - NEARLY_OUTDONE:
        current, (fit,) = looked_closer(bench, current, [fit], RIVAL_SEEDS)
    taken, reason = takes_the_place(
        bench, fit, current, rival.price, _number(bench, rival), explained
    )
    for other, its in fits:
        if other is not rival:
            _note(bench, other, its, False, f"gain {its.log_evidence - current.log_evidence:.1f}")
    _note(bench, rival, fit, taken, reason)
    beyond = fit.log_evidence - current.log_evidence - rival.price
    if not taken:
        close = (_beside(fit, rival),) if beyond > -AMBIGUOUS else ()
        return Round(current, None, close)
    close = (_beside(current, rival),) if beyond < AMBIGUOUS else ()
    return Round(current, pruned(bench, fit), close)


def _chosen(bench: Workbench, base: Fit, current: Fit, explained: bool) -> list[_Rival]:
    """The rivals that are worth a full fit, each formula in the one place where it does best."""
    best: dict[str, _Rival] = {}
    for without, formulas, instead_of in _questions(bench, base, current, explained):
        for rival in _looked_at(bench, without, formulas, instead_of, explained):
            known = best.get(rival.formula.name)
            if known is None or rival.worth > known.worth:
                best[rival.formula.name] = rival
    rivals = sorted(best.values(), key=lambda rival: -rival.worth)
    if not explained:
        return rivals[:FULL_FITS]
    return [one for one in rivals[:1] if one.worth > current.log_evidence - RIVAL_WITHIN]


def _questions(
    bench: Workbench, base: Fit, current: Fit, explained: bool
) -> Iterator[tuple[Fit, list[Effect], tuple[Effect, ...]]]:
    """Models without some effects, the formulas that may stand for those, and these effects."""
    own = current.effects[bench.given :]
    others = [f for f in bench.formulas if f.name not in current.names]
    sites = dict.fromkeys(effect.site for effect in own)
    together = [tuple(effect for effect in own if effect.site == site) for site in sites]
    parts = [(effect,) for effect in own] + together
    if own and not explained:
        parts.append(own)
    for part in dict.fromkeys(parts):
        anywhere = part == own and not explained
        formulas = [f for f in others if anywhere or f.site == part[0].site]
        rest = tuple(effect for effect in current.effects if effect not in part)
        if not formulas:
            continue
        if rest == base.effects:
            yield base, formulas, part
            continue
        names = " and ".join(effect.name for effect in part)
        without = bench.attempt(
            f"the model without {names} failed",
            lambda rest=rest: fit_model(bench.question, rest, (0, 1), (base, current)),
        )
        if without is not None:
            yield without, formulas, part


def _looked_at(
    bench: Workbench,
    without: Fit,
    formulas: Sequence[Effect],
    instead_of: tuple[Effect, ...],
    explained: bool,
) -> list[_Rival]:
    fresh = FRESH[False] if bench.settings.from_prior else 0
    number = len(without.effects) - bench.given + 1

    def look(formula: Effect) -> Glance:
        return glance(bench.question, without, formula, fresh, explained)

    seen = each_of(bench, formulas, number, look)
    return [
        _Rival(one, without, instead_of, bench.price((one.effect,)) - bench.price(instead_of))
        for one in seen
    ]


def _fit_of(bench: Workbench, current: Fit, rival: _Rival):
    def fitted(formula: Effect) -> tuple[_Rival, Fit]:
        effects, start = (*rival.without.effects, formula), (rival.without, current)
        places = rival.seen.places
        return rival, fit_model(bench.question, effects, (0, 1), start=start, places=places)

    return fitted


def _beside(fit: Fit, rival: _Rival) -> Close:
    return Close(fit, fit.log_evidence - rival.without.log_evidence)


def _number(bench: Workbench, rival: _Rival) -> int:
    return len(rival.without.effects) - bench.given + 1


def _note(bench: Workbench, rival: _Rival, fit: Fit, taken: bool, reason: str) -> None:
    """Put a rival among the candidates. Where it is taken, what was asked beside the effects that
    it stands for will be asked anew, and goes."""
    formula, number = rival.formula.name, _number(bench, rival)
    names = [effect.name for effect in rival.instead_of]
    outcome = f"{'accepted' if taken else 'rejected'} in place of {' and '.join(names)}: {reason}"
    outcome += f" of {rival.price:.0f} asked"
    if taken:
        earlier = [c for c in bench.candidates if c.round <= number]
        bench.candidates[:] = gave_way(earlier, names, formula)
    gain = fit.log_evidence - rival.without.log_evidence
    bench.candidates.append(Candidate(formula, number, gain, fit.by_seed, outcome))
    bench.tell(f"{formula} {outcome}")
