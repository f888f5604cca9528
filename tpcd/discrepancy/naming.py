"""One round of naming: every candidate effect beside the model so far, the best of them judged.

Every candidate is fitted jointly with theta from the prior, with the same budget as the model
without it; that model is fitted again from where the best alternatives arrived, since a badly
fitted base is the main cause of false names. Evidence ranks, and blocks held out may veto.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from tpcd.discrepancy.confusion import confusions, signatures
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.screening import Glance, glance
from tpcd.discrepancy.settings import (
    AMBIGUOUS,
    BEATEN,
    CLEAR,
    FRESH,
    IMPROVED,
    UNDECIDED,
    WITHIN,
    WORTH_FITTING,
)
from tpcd.discrepancy.variants import FINER_STEPS, VARIANTS, WIDE_SHAPE, Variant
from tpcd.discrepancy.workbench import (
    Round,
    Workbench,
    alternative,
    each_of,
    fitted_again,
    looked_closer,
    stands,
)
from tpcd.effects.protocol import Effect


def find_confusions(bench: Workbench, base: Fit) -> None:
    """Note which effects these data could not tell apart, whatever their truth is."""
    effects = bench.excited(bench.settings.catalogue)
    bench.confusions[:] = confusions(signatures(bench.question, base, effects))
    if bench.confusions:
        pairs = ", ".join(f"{c.name} from {c.other}" for c in bench.confusions)
        bench.tell(f"preflight: these data hardly tell {pairs}")


def name_one(
    bench: Workbench, current: Fit, pool: Sequence[Effect], adequate: bool, excited: bool = True
) -> Round:
    """Try one more effect of the pool, of those that the data excite or of the others; `adequate`
    says whether the model so far explains all."""
    settings, question = bench.settings, bench.question
    number = len(current.effects) - bench.given + 1
    glances = _glances(bench, current, pool, number, adequate, excited)
    if number == 1 and not bench.glances:
        bench.glances.extend(glances)
    worth = current.log_evidence + WORTH_FITTING[adequate]
    chosen = [g for g in glances[: settings.full_fits] if g.log_evidence > worth]
    places = {g.effect.name: g.place[None] for g in glances}

    def fitted(effect: Effect) -> Fit:
        effects, found = (*current.effects, effect), places[effect.name]
        return fit_model(question, effects, (0,), start=(current,), places=found)

    fits: list[Fit] = []
    top = -math.inf
    for look in chosen:
        if look.log_evidence < top - BEATEN:
            break
        fits += each_of(bench, [look.effect], number, fitted)
        top = max((fit.log_evidence for fit in fits), default=-math.inf)
    near = [
        fitted_again(bench, fit, 1, (current,), places=places[fit.names[-1]])
        if fit.log_evidence > current.log_evidence
        else fit
        for fit in fits
        if fit.log_evidence > top - WITHIN
    ]
    near.sort(key=lambda fit: -fit.log_evidence)
    if settings.base_refit and near:
        base = fitted_again(bench, current, 10, (current, *near[:2]))
        found = base.by_seed[len(current.by_seed) :]
        better = max(found, default=-math.inf) > current.log_evidence + IMPROVED
        current = base
        if better:
            # What the base model has learnt from the alternatives, they may learn from it.
            near = [fitted_again(bench, fit, 11, (current, fit)) for fit in near[:2]]
            near.sort(key=lambda fit: -fit.log_evidence)
    lead = near[0].log_evidence - current.log_evidence if near else -math.inf
    if UNDECIDED[adequate] < lead < CLEAR:
        current, near = looked_closer(bench, current, near)
    for g in glances:
        full = next((f for f in (*near, *fits) if f.names[-1] == g.effect.name), None)
        gain = (g if full is None else full).log_evidence - current.log_evidence
        by_seed = () if full is None else full.by_seed
        bench.candidates.append(Candidate(g.effect.name, number, gain, by_seed))
    if not near:
        return Round(current)
    return _judged(bench, current, near, number)


def better_base(
    bench: Workbench, current: Fit, rival: Fit | None, explained: bool
) -> tuple[Variant, Question] | None:
    """The variant of the base model that explains the data best, if it does so better than the
    model as it is and the `rival`, the best candidate. Another shape need only be as good as the
    rival: an effect that is there is found beside it, and one that is not would stand for it. Only
    the shape is asked about after an effect, since what numerics do would have shown before it, and
    where the model has `explained` the data, which numerics would not."""
    found: list[tuple[float, Variant, Question]] = []
    enough = rival is not None and bench.adequacy(rival).adequate(bench.settings.level)
    first = len(current.effects) == bench.given
    for variant in VARIANTS if first and not explained else (WIDE_SHAPE,):
        if enough and variant is FINER_STEPS:
            continue  # slow, and nothing is left for it to explain
        question = variant.change(bench.question)
        try:
            fit = fit_model(question, current.effects, (0,), start=(current,))
        except Exception as error:  # one failure must not cost the others
            bench.warn(f"{variant.name} failed: {type(error).__name__}: {error}")
            continue
        gain = fit.log_evidence - current.log_evidence
        bench.candidates.append(Candidate(variant.name, 0, gain, fit.by_seed))
        found.append((fit.log_evidence, variant, question))
    if not found:
        return None
    evidence, variant, question = max(found, key=lambda one: one[0])
    least = bench.settings.least_gain
    reached = -math.inf if rival is None else rival.log_evidence
    reached += 0.0 if variant is WIDE_SHAPE else least
    return (variant, question) if evidence >= max(current.log_evidence + least, reached) else None


def pruned(bench: Workbench, fit: Fit, but_last: bool = True) -> Fit:
    """The model without effects that it no longer needs; the last one is not asked about."""
    own = fit.effects[bench.given :]
    for effect in own[:-1] if but_last else own:
        less = tuple(e for e in fit.effects if e is not effect)
        other = fit_model(bench.question, less, (0, 1), start=(fit,))
        if fit.log_evidence - other.log_evidence < bench.price((effect,)):
            bench.tell(f"{effect.name} is no longer needed")
            fit = other
    return fit


def _glances(
    bench: Workbench,
    current: Fit,
    pool: Sequence[Effect],
    number: int,
    adequate: bool,
    excited: bool,
) -> list[Glance]:
    """A quick look at every effect that the data excite, or at the others, the best first."""
    candidates = [effect for effect in pool if effect.name not in current.names]
    chosen = bench.excited(candidates)
    others = [effect for effect in candidates if effect not in chosen]
    if excited:
        for effect in others:
            lacks = ", ".join(bench.coverage.missing(effect.needs))
            outcome = f"not excited: {lacks}"
            bench.candidates.append(Candidate(effect.name, number, math.nan, (), outcome))
    else:
        chosen = others
        again = {(effect.name, number) for effect in others}
        bench.candidates[:] = [c for c in bench.candidates if (c.name, c.round) not in again]
    fresh = FRESH[adequate] if bench.settings.from_prior else 0
    glances = each_of(bench, chosen, number, lambda e: glance(bench.question, current, e, fresh))
    return sorted(glances, key=lambda g: -g.log_evidence)


def _judged(bench: Workbench, current: Fit, near: Sequence[Fit], number: int) -> Round:
    """Whether the best of the candidates is accepted, and what comes close to it."""
    best = near[0]
    accepted, reason = stands(bench, best, current, bench.price(best.effects[-1:]), number)
    outcome = f"{'accepted' if accepted else 'rejected'}: {reason}"
    place = (best.names[-1], number)
    bench.candidates[:] = [
        replace(c, outcome=outcome) if (c.name, c.round) == place else c for c in bench.candidates
    ]
    bench.tell(f"round {number}: {best.names[-1]} {outcome}")
    close = tuple(
        alternative(fit, current)
        for fit in near[1:]
        if fit.log_evidence > best.log_evidence - AMBIGUOUS
    )
    return Round(current, best if accepted else None, close)
