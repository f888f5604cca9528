"""From what the search found to a verdict in plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from tpcd.belief.belief import Belief
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.diagnosis import Alternative, Diagnosis, Gap, NamedEffect, Verdict
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, posterior
from tpcd.discrepancy.heldout import gaps, held_out_errors, prediction_errors, typical_share
from tpcd.discrepancy.report_parts import detection_limits, named_effects, theta_estimates
from tpcd.discrepancy.variants import NUMERICS, Variant
from tpcd.discrepancy.workbench import Workbench
from tpcd.effects.formula import FORMULA_NAMES
from tpcd.random import stream

HALF = 0.5
"""Share of the gap that effects must close to be named where something else is left."""
POWER = 0.6
"""Power of the likelihood in the posterior that is reported. At 1 it is as narrow as a true model
and endless draws would make it, and holds too few of the true sizes (coarsened posteriors: Miller
and Dunson 2019); evidence, which compares models, is taken at 1."""
SEEDS = (40, 41)
"""Of the fits whose posterior is reported; of the model before the first is enough."""


@dataclass(frozen=True)
class Findings:
    """What the rounds arrived at."""

    base: Fit
    final: Fit
    before: Adequacy
    """What the model as it was given leaves."""
    after: Adequacy
    close: tuple[Alternative, ...] = ()
    variants: tuple[Variant, ...] = ()
    """Other base models that were taken instead."""


def conclude(
    bench: Workbench, found: Findings, episodes: Sequence[Episode], fresh: Sequence[Episode]
) -> Diagnosis:
    """The verdict, its effects, and the gap before and after."""
    settings = bench.settings
    gap: tuple[Gap, ...] = ()
    share = math.nan
    if found.final is not found.base:
        models = (found.base, found.final)
        left = settings.adequacy and not found.after.adequate(settings.level)
        held = [held_out_errors(bench.question, f, episodes) for f in models if left or not fresh]
        closes = typical_share(*held) if left else math.nan
        if left and not closes >= HALF:
            found = _without_effects(bench, found, closes)
        else:
            shown = [prediction_errors(bench.question, f, fresh) for f in models] if fresh else held
            channels, share = gaps(*shown, stream(settings.seed, 79))
            gap = tuple(channels)
    first = _reported(bench, found.base, SEEDS if found.final is found.base else SEEDS[:1])
    belief = first if found.final is found.base else _reported(bench, found.final, SEEDS)
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
        alternatives=found.close if effects else (),
        candidates=tuple(bench.candidates),
        log_evidence_base=found.base.log_evidence,
        log_evidence=found.final.log_evidence,
        gap=gap,
        share_closed=share,
        held_out="fresh episodes" if fresh else "blocks held out",
        cells_before=found.before.cells,
        cells_after=found.after.cells,
        unexplained_before=found.before.unexplained,
        unexplained_after=found.after.unexplained,
        theta_before=theta_estimates(first),
        theta_after=theta_estimates(belief),
        shape=shape,
        detection_limits=detection_limits(
            bench.glances, settings.catalogue, bench.coverage, settings.least_gain
        ),
        confusions=tuple(bench.confusions),
        tests=dict(bench.tests),
        coverage=dict(bench.coverage.counts),
        notes=tuple(bench.notes),
        belief=belief,
        belief_before=first,
    )


def _reported(bench: Workbench, fit: Fit, seeds: Sequence[int]) -> Belief:
    """The posterior of a model as it is reported, wider than the one that evidence comes from."""
    question = bench.question
    try:
        wide = fit_model(question, fit.effects, seeds, start=(fit,), step=fit.step, power=POWER)
    except Exception as error:
        bench.warn(f"intervals are too narrow: {type(error).__name__} in the last fit: {error}")
        wide = fit
    return replace(
        posterior(question, wide),
        log_evidence=fit.log_evidence,
        log_evidence_std=fit.cloud.log_evidence_std,
    )


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
        where = f"{after.unexplained:.0%} of the transitions are not explained"
        if after.cells and after.cells_p <= level:
            cell = after.cells[0]
            where += f"; most of it in {cell.channel} ({cell.covariate}) while {cell.mode}"
        besides = f"; besides, {told}" if told else ""
        return "unknown_remains", f"something else is missing: {where}{besides}"
    if not effects:
        return "nothing_missing", "the model explains the data; nothing is missing"
    if found.close:
        others = " or ".join(" + ".join(a.names) for a in found.close)
        told += f"; {others} would explain the data as well"
    if any(effect.name in FORMULA_NAMES for effect in effects):
        return "formula", told
    return "ambiguous" if found.close else "named", told


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
