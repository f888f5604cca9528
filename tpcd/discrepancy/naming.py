"""One round of naming: every candidate effect beside the model so far, the best of them judged.

Candidates that promise a gain are fitted jointly with theta from the prior, with the same budget
as the model without them; that model is fitted again from where the best alternatives arrived, and
from where a quick look at it finds much more, since a badly fitted base is the main cause of false
names. Evidence ranks, and blocks held out may veto.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from tpcd.discrepancy.confusion import confusions, reach_of, signatures
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.limits import limits_of, told_limits
from tpcd.discrepancy.promises import (
    draws_agree,
    looks_at,
    promised_gains,
    quick_fits,
    seen_itself,
)
from tpcd.discrepancy.settings import (
    AMBIGUOUS,
    ASTRAY,
    BEATEN,
    CLEAR,
    FEW_DRAWS,
    FRESH,
    IMPROVED,
    PROMISING,
    UNDECIDED,
    WITHIN,
)
from tpcd.discrepancy.workbench import (
    Close,
    Round,
    Workbench,
    each_of,
    fitted_again,
    looked_closer,
    second_best,
    takes_the_place,
)
from tpcd.effects.protocol import Effect


def find_confusions(bench: Workbench, base: Fit) -> None:
    """Note which effects these data could not tell apart, whatever their truth is."""
    found: dict[str, Float[Tensor, "k r"]] = {}
    for effect in bench.settings.catalogue:

        def own(effect: Effect = effect) -> Float[Tensor, "k r"]:
            bench.begin(f"what {effect.name} would do to these data")
            rows = signatures(bench.question, base, [effect])[effect.name]
            bench.reach[effect.name] = reach_of(bench.question, base, effect, rows)
            return rows

        rows = bench.attempt(f"{effect.name} failed in the preflight", own)
        if rows is not None:
            found[effect.name] = rows
    bench.confusions[:] = confusions(found)
    if bench.confusions:
        pairs = ", ".join(f"{c.name} from {c.other}" for c in bench.confusions)
        bench.tell(f"preflight: these data hardly tell {pairs}")


def name_one(bench: Workbench, current: Fit, pool: Sequence[Effect], adequate: bool) -> Round:
    """Try one more effect of the pool; `adequate` says whether the model so far explains all."""
    settings, question = bench.settings, bench.question
    number = len(current.effects) - bench.given + 1
    fresh = FRESH[adequate] if settings.from_prior else 0
    current, reached = seen_itself(bench, current, fresh)
    glances = looks_at(bench, current, pool, number, fresh)
    if number == 1 and not bench.glances:
        bench.glances.extend(glances)
        if glances and not bench.candidates:  # once, whatever other base is taken
            bench.tell(told_limits(limits_of(bench, current.names)))
    gains = promised_gains(bench, current, glances, number, reached)
    quick: dict[str, Fit] = {}
    lost = settings.from_prior and max(gains.values(), default=0.0) <= PROMISING[False]
    if lost and not adequate and not bench.adequacy(current).adequate(settings.level):
        quick = quick_fits(bench, current, glances, number)
        for name, fit in quick.items():
            gains[name] = max(gains[name], fit.log_evidence - current.log_evidence)
    ranked = sorted(glances, key=lambda g: -gains[g.effect.name])[: settings.full_fits]
    chosen = [g for g in ranked if gains[g.effect.name] > PROMISING[adequate]]
    astray = not adequate and current.worth < FEW_DRAWS
    places = {g.effect.name: g.places for g in glances}

    def fitted(effect: Effect) -> Fit:
        effects, found = (*current.effects, effect), places[effect.name]
        begun = [quick[effect.name]] if effect.name in quick else []
        return fit_model(question, effects, (0,), start=(current, *begun), places=found)

    fits: list[Fit] = []
    top, rise = -math.inf, 0.0
    for look in chosen:
        # What full fits have found beyond what was promised, this one may find too.
        promised = max(look.log_evidence, current.log_evidence + gains[look.effect.name])
        if promised + rise < top - BEATEN and not astray:
            continue
        for fit in each_of(bench, [look.effect], number, fitted):
            fits.append(fit)
            top = max(top, fit.log_evidence)
            rise = max(rise, fit.log_evidence - promised)
    near = [
        fitted_again(bench, fit, 1, (current,), places=places[fit.names[-1]])
        if fit.log_evidence > current.log_evidence
        else fit
        for fit in fits
        if fit.log_evidence > top - (ASTRAY if astray else WITHIN)
    ]
    near.sort(key=lambda fit: -fit.log_evidence)
    if settings.base_refit and near:
        base = fitted_again(bench, current, 10, (current, *near[:2]))
        found = base.by_seed[len(current.by_seed) :]
        better = max(found, default=-math.inf) > current.log_evidence + IMPROVED
        current = base
        if better:
            # What the base model has learnt from the alternatives, they may learn from it.
            again = [fitted_again(bench, fit, 11, (current, fit)) for fit in near[:2]]
            near = sorted([*again, *near[2:]], key=lambda fit: -fit.log_evidence)
    lead = near[0].log_evidence - current.log_evidence if near else -math.inf
    agreed = bool(near) and second_best(near[0]) >= current.log_evidence + settings.least_gain
    undecided = lead > UNDECIDED[adequate] and not (lead >= CLEAR and agreed)
    if undecided and not draws_agree(bench, current, near[0], glances):
        current, near = looked_closer(bench, current, near)
    names = [g.effect.name for g in glances]
    # A round that is made again, since an effect has gone, takes the place of the one before.
    bench.candidates[:] = [c for c in bench.candidates if c.round != number or c.name not in names]
    for g in glances:
        full = next((f for f in (*near, *fits) if f.names[-1] == g.effect.name), None)
        gain = gains[g.effect.name]
        if full is not None:
            gain = full.log_evidence - current.log_evidence
        by_seed = () if full is None else full.by_seed
        bench.candidates.append(Candidate(g.effect.name, number, gain, by_seed))
    _tell_gains(bench, current, bench.candidates[-len(glances) :] if glances else [])
    if not near:
        return Round(current)
    return _judged(bench, current, near, number)


def _tell_gains(bench: Workbench, current: Fit, tried: Sequence[Candidate]) -> None:
    """A line on what was tried in a round: what full fits gain, on each seed, and what the best of
    the others promises."""
    tried = sorted(tried, key=lambda c: -c.gain)
    told = []
    for c in (one for one in tried if one.by_seed):
        seeds = ", ".join(f"{found - current.log_evidence:+.1f}" for found in c.by_seed)
        told.append(f"{c.name} {c.gain:+.1f}" + (f" (seeds {seeds})" if len(c.by_seed) > 1 else ""))
    others = [c for c in tried if not c.by_seed and math.isfinite(c.gain)]
    if others:
        rest = "the others promise" if told else "none of the effects promises more than"
        told.append(f"{rest} {others[0].gain:+.1f}" + (" at most" if told else ""))
    if told:
        bench.tell(f"round {tried[0].round}: gain of log evidence: {'; '.join(told)}")


def _judged(bench: Workbench, current: Fit, near: Sequence[Fit], number: int) -> Round:
    """Whether the best of the candidates is accepted, and what comes close to it."""
    best, price = near[0], bench.price(near[0].effects[-1:])
    accepted, reason = takes_the_place(bench, best, current, price, number, explained=False)
    outcome = f"{'accepted' if accepted else 'rejected'}: {reason}"
    place = (best.names[-1], number)
    bench.candidates[:] = [
        replace(c, outcome=outcome) if (c.name, c.round) == place else c for c in bench.candidates
    ]
    bench.tell(f"round {number}: {best.names[-1]} {outcome}")
    close = tuple(
        Close(fit, fit.log_evidence - current.log_evidence)
        for fit in near[1:]
        if fit.log_evidence > best.log_evidence - AMBIGUOUS
    )
    return Round(current, best if accepted else None, close, best)
