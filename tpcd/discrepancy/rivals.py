"""Formulas in place of effects: a law that the catalogue lacks, of which an effect takes a part.

Friction that grows along the floor is another friction on the wall too, so that an effect is
accepted, and may leave too little for anybody to ask on. Formulas are therefore also asked to
explain the data instead of the effects that were found at their site, and where something is left
instead of all. Each effect has to gain the least that it is accepted for, and a formula, which is
less likely beforehand, twice as much.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import Fit, fit_model
from tpcd.discrepancy.naming import Workbench, each_of, fitted_again, pruned
from tpcd.discrepancy.screening import Glance, glance
from tpcd.discrepancy.settings import CLOSER_SEEDS, FRESH, WITHIN
from tpcd.effects.formula import FORMULAS
from tpcd.effects.protocol import Effect

COUNTS = 2
"""Effects that a formula counts for."""
TRIED = 2
"""Formulas that get a full fit where the effects leave something, whatever the quick look says:
with effects that are not there, the scene may have gone astray."""


@dataclass(frozen=True)
class _Rival:
    """A formula, beside what is left without the effects that it stands for."""

    seen: Glance
    without: Fit
    instead_of: tuple[str, ...]
    asked: float
    """How much more it has to explain than the model with those effects."""


@dataclass(frozen=True)
class _Tried:
    """A rival fitted in full."""

    rival: _Rival
    fit: Fit
    surplus: float
    """How much more than asked it explains."""


def outdone(bench: Workbench, base: Fit, current: Fit, explained: bool) -> Fit:
    """The model with a formula in place of effects, where one explains the data so much better;
    else the model as it is, of which `explained` says whether it leaves nothing. `base` is the
    model without effects of its own."""
    rivals = [
        rival
        for without, formulas, names in _asked(bench, base, current, explained)
        for rival in _looked_at(bench, without, formulas, names)
    ]
    rivals.sort(key=lambda rival: rival.asked - rival.seen.log_evidence)
    if explained:
        bar = current.log_evidence - WITHIN
        rivals = [one for one in rivals[:1] if one.seen.log_evidence - one.asked > bar]
    tried = [one for rival in rivals[:TRIED] if (one := _fitted(bench, current, rival))]
    best = max(tried, key=lambda one: one.surplus, default=None)
    taken = best is not None and best.surplus >= 0
    for one in tried:
        _note(bench, one, taken and one is best)
    return pruned(bench, best.fit) if best is not None and taken else current


def _asked(
    bench: Workbench, base: Fit, current: Fit, explained: bool
) -> Iterator[tuple[Fit, list[Effect], tuple[str, ...]]]:
    """Models without some effects, the formulas that may stand for those, and their names."""
    own = current.effects[bench.given :]
    excited = [formula for formula in bench.excited(FORMULAS) if formula not in own]
    sites = tuple(dict.fromkeys(effect.site for effect in own))
    groups = [((site,), [f for f in excited if f.site == site]) for site in sites]
    if own and not explained:
        everywhere = (sites, excited)
        groups = [everywhere] if len(sites) == 1 else [*groups, everywhere]
    for among, formulas in groups:
        names = tuple(effect.name for effect in own if effect.site in among)
        rest = tuple(e for e in current.effects if e not in own or e.site not in among)
        if formulas and rest == base.effects:
            yield base, formulas, names
        elif formulas:
            start = (base, current)
            yield fit_model(bench.question, rest, (0, 1), start=start), formulas, names


def _looked_at(
    bench: Workbench, without: Fit, formulas: list[Effect], names: tuple[str, ...]
) -> list[_Rival]:
    fresh = FRESH[False] if bench.settings.from_prior else 0
    asked = bench.settings.least_gain * (COUNTS - len(names))
    number = len(without.effects) - bench.given + 1
    seen = each_of(
        bench, formulas, number, lambda formula: glance(bench.question, without, formula, fresh)
    )
    return [_Rival(one, without, names, asked) for one in seen]


def _fitted(bench: Workbench, current: Fit, rival: _Rival) -> _Tried | None:
    """The model with the formula fitted in full; None where that fails."""
    formula, start = rival.seen.effect, (rival.without, current)
    effects, places = (*rival.without.effects, formula), rival.seen.place[None]
    try:
        fit = fit_model(bench.question, effects, (0, 1), start=start, places=places)
    except Exception as error:  # a failure must not cost what was found
        bench.warn(f"{formula.name} failed: {type(error).__name__}: {error}")
        return None
    if abs(fit.log_evidence - current.log_evidence - rival.asked) < WITHIN:
        both = (current, fit)
        current, fit = (fitted_again(bench, one, CLOSER_SEEDS[0], both) for one in both)
    return _Tried(rival, fit, fit.log_evidence - current.log_evidence - rival.asked)


def _note(bench: Workbench, tried: _Tried, taken: bool) -> None:
    rival, fit = tried.rival, tried.fit
    outcome = f"{'accepted' if taken else 'rejected'} in place of {' and '.join(rival.instead_of)}"
    outcome += f": {tried.surplus + rival.asked:+.1f}, {rival.asked:.0f} asked"
    gain = fit.log_evidence - rival.without.log_evidence
    number, name = len(fit.effects) - bench.given, rival.seen.effect.name
    bench.candidates.append(Candidate(name, number, gain, fit.by_seed, outcome))
    bench.tell(f"{name} {outcome}")
