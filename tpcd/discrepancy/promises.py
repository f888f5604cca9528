"""What effects promise to gain beside a model, before any of them is fitted in full."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.nested import nested_gain
from tpcd.discrepancy.screening import Glance, Peak, glance, peak
from tpcd.discrepancy.settings import AGREED, ELSEWHERE, QUICK, QUICK_SEED, TOLD, WEIGHED
from tpcd.discrepancy.workbench import Workbench, each_of, fitted_again
from tpcd.effects.protocol import Effect


def seen_itself(bench: Workbench, current: Fit, fresh: int) -> tuple[Fit, float]:
    """The model so far, fitted again where a quick look at it finds much more than its fits, and
    the log evidence by that look."""

    def look(fit: Fit) -> Peak | None:
        what = "the look at the model itself failed"
        return bench.attempt(what, lambda: peak(bench.question, fit, (), fresh))

    own = look(current)
    if own is not None and own.log_evidence > current.log_evidence + ELSEWHERE:
        current = fitted_again(bench, current, 13, (current,), places=own.place[None])
        own = look(current)
    return current, current.log_evidence if own is None else own.log_evidence


def looks_at(
    bench: Workbench,
    current: Fit,
    pool: Sequence[Effect],
    number: int,
    fresh: int,
) -> list[Glance]:
    """A quick look at every effect, the best first. Also at those that the data hardly excite: what
    an effect does to nothing it cannot gain."""
    chosen = [effect for effect in pool if effect.name not in current.names]
    glances = each_of(bench, chosen, number, lambda e: glance(bench.question, current, e, fresh))
    return sorted(glances, key=lambda g: -g.log_evidence)


def promised_gains(
    bench: Workbench, current: Fit, glances: Sequence[Glance], number: int, reached: float
) -> dict[str, float]:
    """What effects promise to gain: by their look beside what one at the model itself reached, and
    for the best of them by the draws of the model, unless these are few or a look finds much more,
    as it does where an effect takes the scene elsewhere."""
    gains = {g.effect.name: g.log_evidence - reached for g in glances}
    asked: set[str] = set()
    next_ones = list(glances[:WEIGHED])
    while next_ones:
        for look in next_ones:
            name = look.effect.name
            found = bench.attempt(
                f"the gain of {name} by draws failed in round {number}",
                lambda look=look: nested_gain(bench.question, current, look),
            )
            if found is not None:
                told = found.std < TOLD and gains[name] < found.gain + ELSEWHERE
                gains[name] = found.gain if told else max(gains[name], found.gain)
        asked |= {look.effect.name for look in next_ones}
        # Nothing comes before those that were weighed without being weighed itself.
        first = sorted(glances, key=lambda g: -gains[g.effect.name])[: bench.settings.full_fits]
        next_ones = [g for g in first if g.effect.name not in asked and gains[g.effect.name] > 0]
    return gains


def quick_fits(
    bench: Workbench, current: Fit, glances: Sequence[Glance], number: int
) -> dict[str, Fit]:
    """A quick fit of every effect, by name: an effect that takes the scene far away is out of the
    reach of looks, whose points climb alone, and draws that learn from each other find it."""
    sampler = replace(bench.question.sampler, **QUICK)
    question = replace(bench.question, sampler=sampler)
    places = {g.effect.name: g.others for g in glances}

    def fitted(effect: Effect) -> Fit:
        effects, others = (*current.effects, effect), places[effect.name]
        start = (current,)
        return fit_model(question, effects, (QUICK_SEED,), start=start, places=others, passes=1)

    fits = each_of(bench, [g.effect for g in glances], number, fitted)
    return {fit.names[-1]: fit for fit in fits}


def draws_agree(bench: Workbench, current: Fit, best: Fit, glances: Sequence[Glance]) -> bool:
    """Whether the draws of the model so far tell the same gain of the best candidate as the fits
    of both: two ways, of which the one knows only scenes of that model and the other has searched
    twice, have then missed nothing that matters."""
    look = next(g for g in glances if g.effect.name == best.names[-1])
    what = f"the gain of {look.effect.name} by draws failed"
    found = bench.attempt(what, lambda: nested_gain(bench.question, current, look))
    lead = best.log_evidence - current.log_evidence
    return found is not None and found.std < AGREED / 2 and abs(found.gain - lead) < AGREED
