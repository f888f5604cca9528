"""The diagnosis: preflight, fit, locate, name, add and fit again, until nothing is missing.

An absolute test says whether what was found is enough; up to three effects are added, laws that
vary with the contact are asked for in their place and beside them, and what is left after those is
said to be unknown.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from tpcd.belief.belief import misfit_field
from tpcd.belief.history import joined_history
from tpcd.belief.prior import make_prior
from tpcd.belief.resampling import effective_sample_size
from tpcd.belief.settings import EstimatorSettings
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy, free_space_score, parity_score
from tpcd.discrepancy.conclude import Findings, conclude
from tpcd.discrepancy.coverage import contact_rows, coverage_of
from tpcd.discrepancy.diagnosis import Alternative, Diagnosis
from tpcd.discrepancy.fit import TIED, Fit, Question
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.naming import better_base, find_confusions, name_one, pruned
from tpcd.discrepancy.rivals import outdone
from tpcd.discrepancy.settings import (
    ENOUGH_DRAWS,
    FEWEST_DRAWS,
    FEWEST_ROWS,
    FINAL_SEEDS,
    DiagnosisSettings,
)
from tpcd.discrepancy.variants import FINER, Variant, step_halving, strained
from tpcd.discrepancy.workbench import Round, Workbench, fit_well, fitted_again
from tpcd.effects.formula import FORMULAS
from tpcd.effects.protocol import Effect
from tpcd.shape.protocol import Shape

__all__ = ["DiagnosisSettings", "diagnose"]


def diagnose(
    episodes: Sequence[Episode],
    shape: Shape,
    settings: DiagnosisSettings | None = None,
    fresh: Sequence[Episode] = (),
    effects: Sequence[Effect] = (),
    tell: Callable[[str], None] = lambda line: None,
    memory: Memory | None = None,
) -> Diagnosis:
    """Find what the model lacks for the episodes of one set-up.

    `effects` are already part of the model; `fresh` episodes only measure the gap. `tell` gets
    a line for people after each stage; `memory` keeps fits for a run that goes on after being
    stopped. Raises ValueError for episodes of different set-ups.
    """
    started = time.perf_counter()
    settings = settings or DiagnosisSettings()
    question = _question(episodes, shape, settings, memory or Memory())
    bench = Workbench(question, settings, coverage_of(episodes), len(effects), tell)
    stop = _preflight(bench, episodes)
    if stop:
        tell(f"verdict: not enough information: {stop}")
        found = Diagnosis("not_enough_information", stop, coverage=dict(bench.coverage.counts))
    else:
        found = conclude(bench, _search(bench, tuple(effects)), episodes, fresh)
    return replace(found, seconds=time.perf_counter() - started)


def _question(
    episodes: Sequence[Episode], shape: Shape, settings: DiagnosisSettings, memory: Memory
) -> Question:
    history = joined_history(episodes)
    if not settings.parity:
        history = replace(history, parity_counts=False)
    sampler = settings.sampler
    if not settings.from_prior:
        none = ("prior_draws", "fresh_modes", "flat_starts", "flat_tried", "flat_climbers")
        sampler = replace(sampler, **dict.fromkeys(none, 1))
    return Question(
        history,
        make_prior(shape, episodes[0].priors),
        misfit_field(shape, EstimatorSettings()),
        settings.step,
        sampler,
        settings.seed,
        memory,
    )


def _preflight(bench: Workbench, episodes: Sequence[Episode]) -> str:
    """Why the data cannot say anything; empty where they can."""
    question = bench.question
    rows = int(question.history.used.sum())
    needed = max(FEWEST_ROWS, question.scene.dimension)
    touched = (contact_rows(episode) for episode in episodes)
    contact = sum(int((floored | walled).sum()) for floored, walled in touched)
    if rows < needed or contact < 3:
        found = f"{rows} transitions, {contact} of them in contact"
        return f"{found}; a diagnosis needs {needed} transitions and 3 in contact"
    mean, p = parity_score(question.history)
    bench.tests |= {"parity": mean, "parity_p": p}
    bench.tell(
        f"preflight: {rows} transitions, {contact} rows in contact; pose and wrench"
        f" disagree by {mean:.2f} times their noise (p = {p:.2g})"
    )
    free = free_space_score(episodes)
    if free is not None:
        bench.tests |= {"free_space": free[0], "free_space_p": free[1]}
        bench.tell(
            f"preflight: in free space poses leave their commands by {free[0]:.2f} times the noise"
            f" (p = {free[1]:.2g}, {free[2]} rows)"
        )
    return ""


def _search(bench: Workbench, effects: tuple[Effect, ...]) -> Findings:
    """All rounds: the catalogue; formulas in place of what it found, and beside one that is better
    the catalogue once more; where that does not suffice, what the data hardly excite, since an
    effect may be what keeps them from it (a rough wall, on which nothing slips); then formulas
    beside what was found."""
    settings = bench.settings
    base = current = fit_well(bench, effects)
    before = bench.adequacy(base)
    find_confusions(bench, base)
    _tell_adequacy(bench, "the model as it is", before)
    variants: list[Variant] = []
    close: tuple[Alternative, ...] = ()
    asked: set[tuple[str, ...]] = set()
    stages = [(settings.catalogue, True), (settings.catalogue, False), (FORMULAS, True)]
    stage = 0
    while stage < len(stages):
        pool, excited = stages[stage]
        while len(current.effects) - bench.given < settings.most_effects:
            first = len(current.effects) == bench.given
            adequate = bench.adequacy(current).adequate(0.05)
            found = name_one(bench, current, pool, adequate, excited)
            untried = stage == 0 and not variants
            explained = _explains(bench, found.base)
            if untried and not (explained and found.best is None and not strained(found.base)):
                changed = _changed_base(bench, found, explained)
                if changed is not None:
                    variant, current = changed
                    bare = len(current.effects) == bench.given
                    base = current if bare else fit_well(bench, effects, start=(current,))
                    variants.append(variant)
                    _tell_adequacy(bench, f"the model with {variant.name}", bench.adequacy(base))
                    continue
            current = found.base
            if first:
                base = current
            if found.best is None:
                break
            close, current = found.close, pruned(bench, found.best)
        explained = _explains(bench, current)
        found_some = len(current.effects) > bench.given
        if found_some and pool is not FORMULAS and current.names not in asked:
            asked.add(current.names)
            rival = outdone(bench, base, current, explained)
            close = rival.close if rival.best else (*close, *rival.close)
            current = rival.best or rival.base
            if rival.best:
                stage = 0
                continue
        if explained:
            break
        stage += 1
    if current is not base:
        current = fitted_out(bench, current)
    after = bench.adequacy(current)
    _tell_adequacy(bench, "the model found", after)
    halving = step_halving(bench.question, current)
    bench.notes.append(
        f"numerics: with {FINER} times the substeps 95 % of the predictions change by less than"
        f" {halving:.2g} sd"
    )
    bench.tell(bench.notes[-1])
    return Findings(base, current, before, after, tuple(close), tuple(variants))


def _changed_base(bench: Workbench, found: Round, explained: bool) -> tuple[Variant, Fit] | None:
    """Another base model where one explains the data better than any effect, fitted well; what
    is asked from then on is asked of it."""
    better = better_base(bench, found.base, found.best, explained)
    if better is None:
        return None
    variant, bench.question = better
    number = len(found.base.effects) - bench.given + 1
    if number == 1:
        bench.glances.clear()
    bench.candidates[:] = [c for c in bench.candidates if c.round < number]
    fit = fit_well(bench, found.base.effects, start=(found.base,))
    return variant, pruned(bench, fit, but_last=False)


def fitted_out(bench: Workbench, fit: Fit) -> Fit:
    """The model found on further seeds, for the sake of honest intervals: two where few draws
    count, and on while one finds much more than all before it, since the search is still climbing
    then."""
    climbs = False
    for count, seed in enumerate(FINAL_SEEDS):
        enough = count >= 2 or effective_sample_size(fit.cloud.weights) >= ENOUGH_DRAWS
        if enough and not climbs:
            break
        best = max(fit.by_seed)
        fit = fitted_again(bench, fit, seed, (fit,))
        climbs = max(fit.by_seed) > best + TIED
    draws = effective_sample_size(fit.cloud.weights)
    if draws < FEWEST_DRAWS:
        bench.warn(
            f"the posterior of the model found rests on about {draws:.0f} draws, expected at least"
            f" {FEWEST_DRAWS}; sizes are less sure than their intervals say"
        )
    return fit


def _explains(bench: Workbench, fit: Fit) -> bool:
    """Whether a model explains the data, as far as that is asked for."""
    return not bench.settings.adequacy or bench.adequacy(fit).adequate(bench.settings.level)


def _tell_adequacy(bench: Workbench, what: str, found: Adequacy) -> None:
    """A line on what a model leaves."""
    word = "explains the data" if found.adequate(bench.settings.level) else "leaves something"
    top = found.cells[0] if found.cells else None
    where = (
        f"; largest: {top.channel} ({top.covariate}) while {top.mode}, {top.score:+.1f} sd"
        if top
        else ""
    )
    bench.tell(f"{what} {word}: {found.unexplained:.0%} of the transitions unexplained{where}")
