"""The diagnosis: preflight, fit, locate, name, add and fit again, until nothing is missing.

An absolute test says whether what was found is enough; up to three effects are added, laws that
vary with the contact are asked for in their place and beside them, and what is left after those is
said to be unknown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from tpcd.belief.belief import misfit_field
from tpcd.belief.history import History, joined_history
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import EstimatorSettings
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.bases import better_base, held_against, is_doubtful
from tpcd.discrepancy.closeness import carried_on, still_close
from tpcd.discrepancy.conclude import Findings, conclude
from tpcd.discrepancy.coverage import contact_rows, coverage_of
from tpcd.discrepancy.diagnosis import Diagnosis
from tpcd.discrepancy.exchange import Exchanges, exchanged
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.limits import limits_of
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.naming import find_confusions, name_one
from tpcd.discrepancy.preflight import free_space_score, parity_score
from tpcd.discrepancy.pruning import needless, pruned
from tpcd.discrepancy.rivals import outdone
from tpcd.discrepancy.settings import FEWEST_ROWS, DiagnosisSettings
from tpcd.discrepancy.variants import FINER, Variant, step_halving
from tpcd.discrepancy.workbench import Close, Workbench, fit_well
from tpcd.effects.formula import formulas_over
from tpcd.effects.protocol import Effect
from tpcd.shape.protocol import Shape

__all__ = ["DiagnosisSettings", "diagnose"]

BESIDE = 0.06
"""How far beside the hand the floor may be touched [m]."""


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
    coverage, formulas = coverage_of(episodes), _formulas_for(question.history)
    bench = Workbench(question, settings, coverage, len(effects), tell, formulas)
    stop = _preflight(bench, episodes)
    if stop:
        tell(f"verdict: not enough information: {stop}")
        limits = limits_of(bench, [effect.name for effect in effects])
        counts = dict(bench.coverage.counts)
        found = Diagnosis("not_enough_information", stop, detection_limits=limits, coverage=counts)
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
        make_prior(shape, settings.shape.bounds(episodes[0].priors)),
        misfit_field(shape, EstimatorSettings(shape=settings.shape)),
        settings.step,
        sampler,
        settings.seed,
        memory,
    )


def _formulas_for(history: History) -> tuple[Effect, ...]:
    """The formulas, which look for places along the floor where the object has been."""
    x = history.poses[:, 0]
    return formulas_over(float(x.min()) - BESIDE, float(x.max()) + BESIDE)


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
        f" disagree by {math.sqrt(mean):.2f} times their noise (p = {p:.2g})"
    )
    free = free_space_score(episodes)
    if free is not None:
        bench.tests |= {"free_space": free[0], "free_space_p": free[1]}
        bench.tell(
            "preflight: in free space poses leave their commands by"
            f" {math.sqrt(free[0]):.2f} times the noise (p = {free[1]:.2g}, {free[2]} rows)"
        )
    return ""


def _search(bench: Workbench, effects: tuple[Effect, ...]) -> Findings:
    """All rounds: the catalogue; formulas in place of what it found, and beside one that is better
    the catalogue once more; where that does not suffice, formulas beside what was found."""
    settings = bench.settings
    base = current = before = fit_well(bench, effects)
    left = bench.adequacy(base)
    find_confusions(bench, base)
    _tell_adequacy(bench, "the model as it is", left)
    given: tuple[Fit, Question] | None = None
    variants: list[Variant] = []
    close: tuple[Close, ...] = ()
    outdone_asked: set[tuple[str, ...]] = set()
    exchanges = Exchanges()
    gone: set[str] = set()  # added, and then not needed: it would be added again
    stages = [settings.catalogue, bench.formulas]
    stage = 0
    while stage < len(stages):
        pool = [effect for effect in stages[stage] if effect.name not in gone]
        while len(current.effects) - bench.given < settings.most_effects:
            first = len(current.effects) == bench.given
            found = name_one(bench, current, pool, bench.adequacy(current).adequate(0.05))
            explained = _explains(bench, found.base)
            if stage == 0 and not variants and is_doubtful(found, explained):
                again, better = better_base(bench, found.base, found.best, explained)
                if better is not None:
                    given = (base if not first else again, bench.question)
                    base, current = _taken(bench, again, better, effects)
                    variants.append(better[0])
                    close = ()
                    continue
                if again is not found.base:
                    found = held_against(bench, found, again)
            current = found.base
            if first:
                base = current
            tried = found.tried
            if found.best is not None:
                current = pruned(bench, found.best)
                if found.best.effects[-1] in current.effects:
                    kept = carried_on(bench, close, current) if current is found.best else ()
                    close, before = (*kept, *found.close), found.base
                    continue
                gone.add(found.best.names[-1])
                pool = [effect for effect in pool if effect.name not in gone]
                base, tried = (current if first else base), found.best
            # The model without its last effect, or where that is not known, without any.
            without = before if len(before.effects) == len(current.effects) - 1 else base
            explained = _explains(bench, current)
            swap = exchanged(bench, current, tried, without, close, exchanges, explained)
            close = swap.close
            if swap.best is not None:
                current = pruned(bench, swap.best, swap.best.effects[bench.given : -1])
                close = still_close(bench, close, current)
            elif found.best is None:
                break
        explained = _explains(bench, current)
        found_some = len(current.effects) > bench.given
        if found_some and stage == 0 and current.names not in outdone_asked:
            outdone_asked.add(current.names)
            rival = outdone(bench, base, current, explained)
            near = rival.close if rival.best else (*close, *rival.close)
            close = still_close(bench, near, rival.best or rival.base)
            current = rival.best or pruned(bench, rival.base, needless(bench, rival.base))
            if not rival.best and current is not rival.base:
                gone |= set(rival.base.names) - set(current.names)
                base = base if len(current.effects) > bench.given else current
                close = ()
            if rival.best or current is not rival.base:
                stage = 0
                continue
        if explained:
            break
        stage += 1
    after = bench.adequacy(current)
    _tell_adequacy(bench, "the model found", after)
    bench.begin("steps cut further")
    halving = bench.attempt("steps cut further", lambda: step_halving(bench.question, current))
    if halving is not None:
        bench.notes.append(
            f"numerics: with {FINER} times the substeps 95 % of the predictions change by less than"
            f" {halving:.2g} sd"
        )
        bench.tell(bench.notes[-1])
    given = given or (base, bench.question)
    return Findings(*given, base, current, left, after, close, tuple(variants))


def _taken(
    bench: Workbench,
    current: Fit,
    better: tuple[Variant, Question, Fit],
    effects: tuple[Effect, ...],
) -> tuple[Fit, Fit]:
    """The base and the present model of another variant of the base model, of which all is asked
    from then on."""
    variant, bench.question, fit = better
    number = len(current.effects) - bench.given + 1
    if number == 1:
        bench.glances.clear()
    bench.candidates[:] = [c for c in bench.candidates if c.round < number]
    fit = pruned(bench, fit, fit.effects[bench.given :])
    base = fit if len(fit.effects) == bench.given else fit_well(bench, effects, start=(fit,))
    _tell_adequacy(bench, f"the model with {variant.name}", bench.adequacy(base))
    return base, fit


def _explains(bench: Workbench, fit: Fit) -> bool:
    """Whether a model explains the data, as far as that is asked for."""
    return not bench.settings.adequacy or bench.adequacy(fit).adequate(bench.settings.level)


def _tell_adequacy(bench: Workbench, what: str, found: Adequacy) -> None:
    """A line on what a model leaves."""
    left = found.left(bench.settings.level)
    if left:
        bench.tell(f"{what} leaves something: {left}")
        return
    top = f"; at most, {found.cells[0].words}" if found.cells else ""
    share = f"{found.unexplained:.0%} of the transitions unexplained"
    bench.tell(f"{what} explains the data: {share}{top}")
