"""What a diagnosis works on, and how its models are fitted and weighed against each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from tpcd.discrepancy.adequacy import Adequacy, check_adequacy
from tpcd.discrepancy.confusion import Reach
from tpcd.discrepancy.coverage import Coverage
from tpcd.discrepancy.diagnosis import Candidate, Confusion
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question, joined_fit, model_name
from tpcd.discrepancy.heldout import held_out_scores, lower_bound
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.settings import (
    AGREED,
    CLIMBING,
    CLOSER,
    CLOSER_SEEDS,
    FORMULA_COUNTS,
    SURE,
    VETO_LEVEL,
    DiagnosisSettings,
)
from tpcd.effects.formula import FORMULA_NAMES, FORMULAS
from tpcd.effects.protocol import Effect
from tpcd.errors import FileError
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
    formulas: Sequence[Effect] = FORMULAS
    """What is tried where the catalogue does not suffice, and in place of what it found."""
    candidates: list[Candidate] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    glances: list[Glance] = field(default_factory=list)
    """Of the first round."""
    confusions: list[Confusion] = field(default_factory=list)
    reach: dict[str, tuple[Reach, ...]] = field(default_factory=dict)
    """What each parameter of an effect does to the innovations, beyond theta."""
    tests: dict[str, float] = field(default_factory=dict)
    """What needs no theta: mean chi-square of parity and of free space, with probabilities."""
    left: dict[str, Adequacy] = field(default_factory=dict)
    """What models leave, by the fingerprints of question and fit."""

    def begin(self, what: str) -> None:
        """Say what comes next, to whoever watches."""
        self.question.memory.watch(what)

    def warn(self, line: str) -> None:
        """Note something, and say it at once."""
        self.notes.append(" ".join(line.split()))
        self.tell(f"warning: {self.notes[-1]}")

    def price(self, effects: Sequence[Effect]) -> float:
        """The gain of log evidence that these have to bring."""
        counts = sum(FORMULA_COUNTS if effect.name in FORMULA_NAMES else 1 for effect in effects)
        return counts * self.settings.least_gain

    def adequacy(self, fit: Fit) -> Adequacy:
        """What a model leaves."""
        key = self.question.fingerprint + fit.fingerprint
        if key not in self.left:
            self.begin(f"what {model_name(fit.effects)} leaves")
            generator = stream(self.settings.seed, 78)
            self.left[key] = check_adequacy(self.question, fit, generator)
        return self.left[key]

    def attempt(self, what: str, work: Callable[[], Result]) -> Result | None:
        """What some work on a model comes to; where it fails, a warning and None, since one model
        must not cost the others. What is wrong with files or memory is no model's fault, and is
        raised."""
        try:
            return work()
        except (FileError, OSError, MemoryError):
            raise
        except Exception as error:
            self.warn(f"{what}: {type(error).__name__}: {error}")
            return None


@dataclass(frozen=True)
class Close:
    """A model that explains the data about as well as the one that is taken."""

    fit: Fit
    gain: float
    """Log evidence minus that of the model of the round before."""


@dataclass(frozen=True)
class Round:
    """What one round arrived at."""

    base: Fit
    """The model before, perhaps better fitted."""
    best: Fit | None = None
    """The model with one more effect, where one is accepted."""
    close: tuple[Close, ...] = ()
    """What explains the data about as well as that."""
    tried: Fit | None = None
    """The best model with one more effect, accepted or not."""


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
    places: Float[Tensor, "k s"] | None = None,
) -> Fit:
    """The fit with one more seed of its model, as for `fit_model`; as it is where that fails."""
    asked = bench.question if question is None else question
    again = bench.attempt(
        f"{model_name(fit.effects)} failed when fitted again",
        lambda: fit_model(asked, fit.effects, (seed,), start=start, places=places),
    )
    return fit if again is None else joined_fit(fit, again)


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
        found = (max(fit.by_seed) for fit in (current, best))
        if max(now - then for now, then in zip(found, before, strict=True)) < CLIMBING:
            break
    return current, near


def second_best(fit: Fit) -> float:
    """Log evidence on the second best seed of a model, which should agree with the best."""
    return sorted(fit.by_seed)[-2] if len(fit.by_seed) > 1 else -math.inf


def stands(
    bench: Workbench, best: Fit, current: Fit, price: float, number: int
) -> tuple[bool, str]:
    """Whether a model gains the price over another, nearly so on a second seed and, where that is
    not much, on blocks held out; and what it gains."""
    gain = best.log_evidence - current.log_evidence
    second = second_best(best)
    reason = f"gain {gain:.1f}"
    if gain < price:
        return False, reason
    if second < current.log_evidence + price - AGREED:
        return False, f"{reason}, on a second seed {second - current.log_evidence:.1f}"
    if price <= 0 or gain >= SURE:
        return True, reason

    def bound() -> float:
        own, base = (held_out_scores(bench.question, fit) for fit in (best, current))
        return lower_bound(own - base, stream(bench.settings.seed, 77, number), VETO_LEVEL)

    bench.begin(f"{model_name(best.effects)} on blocks held out")
    held = bench.attempt(f"{best.names[-1]} failed on blocks held out", bound)
    if held is None:
        return False, f"{reason}, not told on blocks held out"
    return held > 0, f"{reason}, held-out gain at least {held:+.2f} a transition"


def takes_the_place(
    bench: Workbench, fit: Fit, current: Fit, price: float, number: int, explained: bool
) -> tuple[bool, str]:
    """Whether a model takes the place of another one: it `stands` against it, and leaves nothing
    where that has `explained` the data; and why."""
    taken, reason = stands(bench, fit, current, price, number)
    if taken:
        left = bench.attempt(f"{fit.names[-1]} failed", lambda: bench.adequacy(fit))
        if left is None:
            taken, reason = False, f"{reason}, what it leaves is not told"
        elif explained and bench.settings.adequacy and not left.adequate(bench.settings.level):
            taken, reason = False, f"{reason}, but it leaves something"
    return taken, reason


def gave_way(candidates: Iterable[Candidate], names: Sequence[str], to: str) -> list[Candidate]:
    """Candidates, of which the accepted ones of these names gave way to another effect."""
    return [
        replace(c, outcome=f"{c.outcome}; gave way to {to}")
        if c.name in names and c.outcome.startswith("accepted")
        else c
        for c in candidates
    ]


def each_of(
    bench: Workbench, effects: Sequence[Effect], number: int, work: Callable[[Effect], Result]
) -> list[Result]:
    """Do something with every candidate; one that fails costs no other."""
    done = (
        bench.attempt(f"{effect.name} failed in round {number}", lambda e=effect: work(e))
        for effect in effects
    )
    return [one for one in done if one is not None]
