"""What a diagnosis works on, and how its models are fitted and weighed against each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from torch import Tensor

from tpcd.discrepancy.adequacy import Adequacy, check_adequacy
from tpcd.discrepancy.coverage import MOTIONS, Coverage
from tpcd.discrepancy.diagnosis import Alternative, Candidate, Confusion
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import TIED, Fit, Question, joined_fit
from tpcd.discrepancy.heldout import held_out_scores, lower_bound
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.settings import (
    CLOSER,
    CLOSER_SEEDS,
    FORMULA_COUNTS,
    SURE,
    VETO_LEVEL,
    DiagnosisSettings,
)
from tpcd.effects.formula import FORMULA_NAMES
from tpcd.effects.protocol import Effect
from tpcd.random import stream

Result = TypeVar("Result")


@dataclass
class Workbench:
    """What a diagnosis works on, and what it has noted so far."""

    question: Question
    settings: DiagnosisSettings
    coverage: Coverage
    given: int
    """Effects that are part of the model to begin with."""
    tell: Callable[[str], None]
    candidates: list[Candidate] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    glances: list[Glance] = field(default_factory=list)
    """Of the first round."""
    confusions: list[Confusion] = field(default_factory=list)
    tests: dict[str, float] = field(default_factory=dict)
    """What needs no theta: mean chi-square of parity and of free space, with probabilities."""

    def warn(self, line: str) -> None:
        """Note something, and say it at once."""
        self.notes.append(" ".join(line.split()))
        self.tell(f"warning: {self.notes[-1]}")

    def excited(self, effects: Sequence[Effect]) -> list[Effect]:
        """Those of the effects that the data could show."""
        return [effect for effect in effects if not self.coverage.missing(effect.needs)]

    def price(self, effects: Sequence[Effect]) -> float:
        """The gain of log evidence that these have to bring."""
        counts = sum(FORMULA_COUNTS if effect.name in FORMULA_NAMES else 1 for effect in effects)
        return counts * self.settings.least_gain

    def adequacy(self, fit: Fit) -> Adequacy:
        """What a model leaves."""
        return check_adequacy(self.question, fit, stream(self.settings.seed, 78))


@dataclass(frozen=True)
class Round:
    """What one round arrived at."""

    base: Fit
    """The model before, perhaps better fitted."""
    best: Fit | None = None
    """The model with one more effect, where one is accepted."""
    close: tuple[Alternative, ...] = ()
    """What explains the data about as well."""


def fit_well(bench: Workbench, effects: Sequence[Effect], start: Sequence[Fit] = ()) -> Fit:
    """A model on two seeds, and on a third where they do not agree."""
    fit = fit_model(bench.question, effects, (0, 1), start=start)
    if fit.spread > 2.0:
        fit = joined_fit(fit, fit_model(bench.question, effects, (2,), start=(*start, fit)))
    return fit


def fitted_again(
    bench: Workbench,
    fit: Fit,
    seed: int,
    start: Sequence[Fit],
    question: Question | None = None,
    places: Tensor | None = None,
) -> Fit:
    """The fit with one more seed of its model, as for `fit_model`; as it is where that fails."""
    asked = bench.question if question is None else question
    try:
        return joined_fit(fit, fit_model(asked, fit.effects, (seed,), start=start, places=places))
    except Exception as error:
        model = ", ".join(fit.names) or "the base model"
        bench.warn(f"{model} failed when fitted again: {type(error).__name__}: {error}")
        return fit


def looked_closer(
    bench: Workbench, current: Fit, near: list[Fit], seeds: Sequence[int] = CLOSER_SEEDS
) -> tuple[Fit, list[Fit]]:
    """The base model and the best candidate with a wider search, each from where both arrived:
    where they are close, what the search over shapes has missed may decide. On while one of them
    finds much more than before, since the search is still climbing then."""
    sampler = bench.question.sampler
    names = ("fresh_modes", "flat_starts", "flat_tried", "flat_climbers")
    more = {name: CLOSER * getattr(sampler, name) for name in names}
    wide = replace(bench.question, sampler=replace(sampler, **more))
    for seed in seeds:
        both, others = (current, near[0]), near[1:]
        before = [max(fit.by_seed) for fit in both]
        current, best = (fitted_again(bench, fit, seed, both, question=wide) for fit in both)
        near = sorted((best, *others), key=lambda fit: -fit.log_evidence)
        if max(max(f.by_seed) - b for f, b in zip((current, best), before, strict=True)) < TIED:
            break
    return current, near


def stands(
    bench: Workbench, best: Fit, current: Fit, price: float, number: int
) -> tuple[bool, str]:
    """Whether a model gains the price over another, on two seeds and, where that is not much, on
    blocks held out; and what it gains."""
    gain = best.log_evidence - current.log_evidence
    least = current.log_evidence + min(price, 0.0)
    accepted = gain >= price and sum(evidence > least for evidence in best.by_seed) >= 2
    reason = f"gain {gain:.1f}"
    if accepted and price > 0 and gain < SURE:
        own, base = (held_out_scores(bench.question, fit) for fit in (best, current))
        generator = stream(bench.settings.seed, 77, number)
        bound = lower_bound(own - base, generator, VETO_LEVEL)
        reason += f", held-out gain at least {bound:+.2f} a transition"
        accepted = bound > 0
    return accepted, reason


def alternative(fit: Fit, without: Fit) -> Alternative:
    """A model that comes close to the one that is taken."""
    motion = "; or ".join(MOTIONS.get(need, need) for need in fit.effects[-1].needs)
    return Alternative(fit.names, fit.log_evidence - without.log_evidence, motion)


def each_of(
    bench: Workbench, effects: Sequence[Effect], number: int, work: Callable[[Effect], Result]
) -> list[Result]:
    """Do something with every candidate; one that fails costs no other."""
    done = []
    for effect in effects:
        try:
            done.append(work(effect))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            bench.warn(f"{effect.name} failed in round {number}: {reason}")
    return done
