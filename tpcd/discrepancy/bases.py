"""Another base model beside the candidates of a round: when it is asked for, and if it wins."""

from __future__ import annotations

import math
from dataclasses import replace

from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.variants import FINER_STEPS, VARIANTS, WIDE_SHAPE, Variant, strained
from tpcd.discrepancy.workbench import Round, Workbench, fit_well, fitted_again


def is_doubtful(found: Round, explained: bool) -> bool:
    """Whether another base model is asked for: where something is left, would be added, or stands
    for what the shape prior does not know."""
    return not explained or found.best is not None or strained(found.base)


def better_base(
    bench: Workbench, current: Fit, rival: Fit | None, explained: bool
) -> tuple[Fit, tuple[Variant, Question, Fit] | None]:
    """The model as it is, perhaps better fitted, and the variant of it that explains the data best,
    if it does so better than the model as it is and the `rival`, the best candidate. Another shape
    need only be as good as the rival: an effect that is there is found beside it, and one that is
    not would stand for it. Only the shape is asked about after an effect, since what numerics do
    would have shown before it, and where the model has `explained` the data, which numerics would
    not. What wins on one seed has to win on two, against a model that starts from where it is."""
    found: list[tuple[Fit, Variant, Question]] = []
    enough = rival is not None and bench.adequacy(rival).adequate(bench.settings.level)
    first = len(current.effects) == bench.given
    for variant in VARIANTS if first and not explained else (WIDE_SHAPE,):
        if enough and variant is FINER_STEPS:
            continue  # slow, and nothing is left for it to explain
        question = variant.change(bench.question)
        fit = bench.attempt(
            f"{variant.name} failed",
            lambda q=question: fit_model(q, current.effects, (0,), start=(current,)),
        )
        if fit is not None:
            found.append((fit, variant, question))
    reached = -math.inf if rival is None else rival.log_evidence
    least = bench.settings.least_gain

    def wins(fit: Fit, variant: Variant) -> bool:
        more = 0.0 if variant is WIDE_SHAPE else least
        return fit.log_evidence >= max(current.log_evidence + least, reached + more)

    best = max(found, key=lambda one: one[0].log_evidence, default=None)
    chosen = None
    if best is not None and wins(*best[:2]):
        fit, variant, question = best
        wide = replace(bench, question=question)
        current = fitted_again(bench, current, 12, (current, fit))
        well = bench.attempt(
            f"{variant.name} failed when fitted again",
            lambda: fit_well(wide, current.effects, start=(current, fit)),
        )
        if well is not None and wins(well, variant):
            chosen = variant, question, well
    names = [variant.name for _, variant, _ in found]
    bench.candidates[:] = [c for c in bench.candidates if c.round or c.name not in names]
    for fit, variant, _ in found:
        taken = chosen is not None and variant is chosen[0]
        shown = chosen[2] if chosen is not None and taken else fit
        gain, outcome = shown.log_evidence - current.log_evidence, "accepted" if taken else ""
        bench.candidates.append(Candidate(variant.name, 0, gain, shown.by_seed, outcome))
    return current, chosen


def held_against(bench: Workbench, found: Round, base: Fit) -> Round:
    """A round beside a base model that is fitted better, of which its best may gain too little."""
    best = found.best
    if best is None:
        return replace(found, base=base)
    gain = best.log_evidence - base.log_evidence
    if gain >= bench.price(best.effects[-1:]):
        return replace(found, base=base)
    place = (best.names[-1], len(base.effects) - bench.given + 1)
    outcome = f"rejected: gain {gain:.1f} over the model fitted again"
    bench.candidates[:] = [
        replace(c, outcome=outcome) if (c.name, c.round) == place else c for c in bench.candidates
    ]
    bench.tell(f"round {place[1]}: {place[0]} {outcome}")
    return Round(base, tried=best)
