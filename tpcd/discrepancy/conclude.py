"""From what the search found to a verdict in plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from tpcd.belief.belief import Belief
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.deciding import deciding_motion
from tpcd.discrepancy.diagnosis import BLOCKS, Alternative, Diagnosis, NamedEffect, Verdict
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question, joined_fit, posterior
from tpcd.discrepancy.gaps import Errors, Gaps, gaps, typical_share
from tpcd.discrepancy.heldout import held_out_errors, prediction_errors
from tpcd.discrepancy.limits import limits_of
from tpcd.discrepancy.report_parts import given_effects, named_effects, theta_estimates
from tpcd.discrepancy.settings import ENOUGH_DRAWS, FEWEST_DRAWS, REPORTED_SEEDS
from tpcd.discrepancy.variants import NUMERICS, Variant
from tpcd.discrepancy.workbench import Close, Workbench
from tpcd.effects.formula import FORMULA_NAMES
from tpcd.random import stream

HALF = 0.5
"""Share of the gap that effects must close to be named where something else is left."""
POWER = 0.6
"""Power of the likelihood in the posterior that is reported. At 1 it is as narrow as a true model
and endless draws would make it, and holds too few of the true sizes (coarsened posteriors: Miller
and Dunson 2019); evidence, which compares models, is taken at 1."""


@dataclass(frozen=True)
class Findings:
    """What the rounds arrived at."""

    given: Fit
    """The model as it was given,"""
    asked: Question
    """and what it was asked."""
    base: Fit
    """The model without effects of its own, perhaps a variant of the one given."""
    final: Fit
    before: Adequacy
    """What the model as it was given leaves."""
    after: Adequacy
    close: tuple[Close, ...] = ()
    """Models that explain the data about as well as the final one."""
    variants: tuple[Variant, ...] = ()
    """Other base models that were taken instead."""

    @property
    def repairs(self) -> bool:
        """Whether the final model has something that is named, and not only another shape."""
        return self.final is not self.base or any(v.name in NUMERICS for v in self.variants)


def conclude(
    bench: Workbench, found: Findings, episodes: Sequence[Episode], fresh: Sequence[Episode]
) -> Diagnosis:
    """The verdict, its effects, and the gap before and after."""
    settings = bench.settings
    gap = Gaps((), (), *(math.nan,) * 4)
    left = settings.adequacy and not found.after.adequate(settings.level)
    held: list[Errors] | None = None
    if found.final is not found.base and left:
        held = _errors(bench, [(bench.question, f) for f in (found.base, found.final)], episodes)
        closes = math.nan if held is None else typical_share(*held)
        if not closes >= HALF:
            found = _without_effects(bench, found, closes)
    if found.repairs:
        shown = held if found.given is found.base and not fresh else None
        if shown is None:
            models = [(found.asked, found.given), (bench.question, found.final)]
            shown = _errors(bench, models, episodes, fresh)
        if shown is not None:
            gap = gaps(*shown, stream(settings.seed, 79))
    belief = first = _reported(bench, bench.question, found.final, REPORTED_SEEDS)
    if found.final is not found.given:
        first = _reported(bench, found.asked, found.given, REPORTED_SEEDS[:1])
    effects = (
        *(NamedEffect("numerics", (), v.note) for v in found.variants if v.name in NUMERICS),
        *named_effects(belief, bench.given),
    )
    verdict, sentence = _verdict(bench, found, effects)
    shape = _shape_line(belief, found.variants)
    bench.tell(f"shape: {shape}")
    bench.tell(f"verdict: {verdict.replace('_', ' ')}: {sentence}")
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        effects=effects,
        given=given_effects(belief, bench.given),
        alternatives=_alternatives(bench, found, episodes) if effects else (),
        candidates=tuple(bench.candidates),
        log_evidence_base=found.given.log_evidence,
        log_evidence_base_by_seed=found.given.by_seed,
        log_evidence=found.final.log_evidence,
        log_evidence_by_seed=found.final.by_seed,
        gap=gap.channels,
        gap_by_contact=gap.by_contact,
        share_closed=gap.share,
        share_closed_low=gap.low,
        share_closed_high=gap.high,
        share_closed_typical=gap.typical,
        held_out="fresh episodes" if fresh else BLOCKS,
        cells_before=found.before.cells,
        cells_after=found.after.cells,
        unexplained_before=found.before.unexplained,
        unexplained_after=found.after.unexplained,
        unexplained_rows=tuple(row for row, _ in found.after.beyond),
        theta_before=theta_estimates(first),
        theta_after=theta_estimates(belief),
        shape=shape,
        detection_limits=limits_of(bench, found.given.names),
        confusions=tuple(bench.confusions),
        tests=dict(bench.tests),
        coverage=dict(bench.coverage.counts),
        notes=tuple(bench.notes),
        belief=belief,
        belief_before=first,
    )


def _errors(
    bench: Workbench,
    models: Sequence[tuple[Question, Fit]],
    episodes: Sequence[Episode],
    fresh: Sequence[Episode] = (),
) -> list[Errors] | None:
    """Errors of models on fresh episodes, else on blocks held out; None where one fails."""

    def each() -> list[Errors]:
        if fresh:
            return [prediction_errors(*model, fresh) for model in models]
        return [held_out_errors(*model, episodes) for model in models]

    bench.begin("one-step errors")
    return bench.attempt("the gap cannot be told", each)


def _alternatives(
    bench: Workbench, found: Findings, episodes: Sequence[Episode]
) -> tuple[Alternative, ...]:
    """What else explains the data, with the motion that would decide."""
    told = []
    for one in found.close:
        names = " and ".join(one.fit.names)
        bench.begin(f"a motion that tells it from {names}")
        motion = bench.attempt(
            f"no motion that tells it from {names}",
            lambda fit=one.fit: deciding_motion(bench.question, found.final, fit, episodes[0]),
        )
        if motion:
            bench.tell(f"{names} would explain the data as well; what decides: {motion}")
        told.append(Alternative(one.fit.names, one.gain, motion or "not told"))
    return tuple(told)


def _reported(bench: Workbench, question: Question, fit: Fit, seeds: Sequence[int]) -> Belief:
    """The posterior of a model as it is reported, wider than the one that evidence comes from: on
    two of the seeds, and on while few draws count."""
    wide: Fit | None = None
    for count, seed in enumerate(seeds):
        if wide is not None and count >= 2 and wide.worth >= ENOUGH_DRAWS:
            break
        more = bench.attempt(
            "intervals are too narrow, the last fit failed",
            lambda seed=seed: fit_model(
                question, fit.effects, (seed,), start=(fit,), step=fit.step, power=POWER
            ),
        )
        if more is None:
            break
        wide = more if wide is None else joined_fit(wide, more)
    wide = wide or fit
    if wide.worth < FEWEST_DRAWS:
        model = " and ".join(fit.names) or "the model without effects"
        bench.warn(
            f"the posterior of {model} rests on about {wide.worth:.0f} draws, expected at least"
            f" {FEWEST_DRAWS}; sizes are less sure than their intervals say"
        )
    return replace(posterior(question, wide), log_evidence=fit.log_evidence)


def _without_effects(bench: Workbench, found: Findings, share: float) -> Findings:
    """The model without effects that leave something and close less than half of the gap: what is
    missing is something else, of which they take a part."""
    names = " and ".join(found.final.names[bench.given :])
    part = f"{share:.0%} of the gap" if math.isfinite(share) else "no gap that can be told"
    bench.notes.append(f"{names} would close {part} while something is left, so it is not named")
    bench.tell(bench.notes[-1])
    return replace(found, final=found.base, after=bench.adequacy(found.base), close=())


def _verdict(
    bench: Workbench, found: Findings, effects: Sequence[NamedEffect]
) -> tuple[Verdict, str]:
    told = " and ".join(effect.sentence for effect in effects)
    after, level = found.after, bench.settings.level
    if bench.settings.adequacy and not after.adequate(level):
        besides = f"; besides, {told}" if told else ""
        return "unknown_remains", f"something else is missing: {after.left(level)}{besides}"
    if not effects:
        return "nothing_missing", _nothing(bench)
    if found.close:
        others = " or ".join(" + ".join(one.fit.names) for one in found.close)
        told += f"; {others} would explain the data as well"
    if any(effect.name in FORMULA_NAMES for effect in effects):
        return "formula", told
    return "ambiguous" if found.close else "named", told


def _nothing(bench: Workbench) -> str:
    """That nothing is missing, and what these data could not have shown."""
    lacking = [e.name for e in bench.settings.catalogue if bench.coverage.missing(e.needs)]
    text = "the model explains the data; nothing is missing"
    if not lacking:
        return text
    return f"{text} that they show; they hardly excite {', '.join(lacking)}"


def _shape_line(belief: Belief, variants: Sequence[Variant]) -> str:
    """What the data say of the outline beyond the shape prior, which is no effect."""
    sd = float(belief.weights @ belief.misfit_sd)
    text = f"the outline differs from those of the prior by about {1e3 * sd:.1f} mm"
    for variant in variants:
        if variant.name not in NUMERICS:
            place = belief.prior.names.index("scale")
            scale = f"scale {float(belief.mean()[place]):.2f}"
            text = f"{variant.note}: explained with {scale}, and {text}"
    return text
