"""The diagnosis: preflight, fit, locate, name, add and fit again, until nothing is missing.

Every candidate is fitted jointly with theta from the prior, with the same budget as the model
without it; that model is fitted again from where the best alternatives arrived, since a badly
fitted base is the main cause of false names. Evidence ranks, blocks held out may veto, and an
absolute test says whether what was found is enough.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from tpcd.belief.belief import EstimatorSettings, misfit_field
from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.history import joined_history
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy, check_adequacy, parity_score
from tpcd.discrepancy.coverage import MOTIONS, Coverage, coverage_of
from tpcd.discrepancy.diagnosis import Alternative, Candidate, Diagnosis, Verdict
from tpcd.discrepancy.evidence import FIT_SAMPLER, Fit, Question, fit_model, joined_fit, posterior
from tpcd.discrepancy.formula import FORMULAS
from tpcd.discrepancy.heldout import (
    gaps,
    held_out_errors,
    held_out_scores,
    lower_bound,
    prediction_errors,
)
from tpcd.discrepancy.report_parts import detection_limits, named_effects, theta_estimates
from tpcd.discrepancy.screening import Glance, glance
from tpcd.effects import CATALOGUE
from tpcd.effects.protocol import Effect
from tpcd.random import stream
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings

Result = TypeVar("Result")

FEWEST_ROWS = 10
"""Transitions below which nothing is named."""
FRESH = {True: 8, False: 40}
"""Points of a quick look that set out from all over the prior, where the model explains the data
and where it does not."""
WORTH_FITTING = {True: -2.0, False: -25.0}
"""Gain of the quick look from which a candidate gets a full fit at all: where the model explains
the data as it is, and where it does not."""
WITHIN = 15.0
"""Candidates whose gain is so close to the best get a second seed."""
AMBIGUOUS = 3.0
SURE = 25.0
"""Gain from which blocks held out have no veto: their fits to fewer data are less sure than it."""
FINAL_SEEDS = (20, 21)
"""Further seeds of the model that was found."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """Choices of the workflow."""

    seed: int = 0
    base_refit: bool = True
    """Fit the base model again from where the alternatives arrived."""
    from_prior: bool = True
    """Search for modes from all over the prior; else only from where the base model arrived."""
    adequacy: bool = True
    """Test whether the final model explains the data."""
    parity: bool = True
    """Let what pose and wrench say about each other count."""
    most_effects: int = 3
    full_fits: int = 4
    """Candidates of a round that are fitted in full."""
    least_gain: float = 6.0
    """Gain of log evidence at which an effect is accepted: 3 and the logarithm of the number of
    candidates, each of which has a share of the prior odds."""
    level: float = 0.001
    """Level of the test that says whether something is left."""
    step: StepSettings = field(default_factory=StepSettings)
    sampler: SamplerSettings = FIT_SAMPLER
    catalogue: tuple[Effect, ...] = CATALOGUE


def diagnose(
    episodes: Sequence[Episode],
    shape: Shape,
    settings: DiagnosisSettings | None = None,
    fresh: Sequence[Episode] = (),
    effects: Sequence[Effect] = (),
    tell: Callable[[str], None] = lambda line: None,
) -> Diagnosis:
    """Find what the model lacks for the episodes of one set-up.

    `effects` are already part of the model; `fresh` episodes only measure the gap. `tell` gets
    a line for people after each stage. Raises ValueError for episodes of different set-ups.
    """
    return _Run(episodes, shape, settings or DiagnosisSettings(), fresh, effects, tell).diagnosis()


class _Run:
    """One diagnosis under way."""

    def __init__(
        self,
        episodes: Sequence[Episode],
        shape: Shape,
        settings: DiagnosisSettings,
        fresh: Sequence[Episode],
        effects: Sequence[Effect],
        tell: Callable[[str], None],
    ) -> None:
        estimator = EstimatorSettings()
        self.started = time.perf_counter()
        self.settings, self.fresh, self.tell = settings, fresh, tell
        self.episodes, self.given = episodes, tuple(effects)
        history = joined_history(episodes)
        if not settings.parity:
            history = replace(history, parity_counts=False)
        sampler = settings.sampler
        if not settings.from_prior:
            sampler = replace(sampler, fresh_modes=1, prior_draws=1)
        self.question = Question(
            history,
            make_prior(shape, episodes[0].priors),
            misfit_field(shape, estimator),
            settings.step,
            sampler,
            settings.seed,
        )
        self.coverage: Coverage = coverage_of(episodes)
        self.candidates: list[Candidate] = []
        self.notes: list[str] = []
        self.glances: list[Glance] = []

    def diagnosis(self) -> Diagnosis:
        """Run all stages."""
        rows = int(self.question.history.used.sum())
        needed = max(FEWEST_ROWS, self.question.scene.dimension)
        contact = self.coverage.counts["floor load"] + self.coverage.counts["wall load"]
        if rows < needed or contact < 3:
            found = f"{rows} transitions, {contact:.0f} of them in contact"
            return self._stop(f"{found}; a diagnosis needs {needed} transitions and 3 in contact")
        mean, p = parity_score(self.question.history)
        self.tell(
            f"preflight: {rows} transitions, {contact:.0f} rows in contact; pose and wrench"
            f" disagree by {mean:.2f} times their noise (p = {p:.2g})"
        )
        base = current = self._fit_well(self.given)
        before = self._adequacy(base)
        self._tell_adequacy("the model as it is", before)
        alternatives: list[Alternative] = []
        pools: tuple[Sequence[Effect], ...] = (self.settings.catalogue, FORMULAS)
        for pool in pools:
            while len(current.effects) - len(self.given) < self.settings.most_effects:
                number = len(current.effects) - len(self.given) + 1
                adequate = self._adequacy(current).adequate(0.05)
                current, best, close = self._round(current, pool, number, adequate)
                if number == 1:
                    base = current
                if best is None:
                    break
                alternatives = close
                current = self._pruned(best)
            now = self._adequacy(current)
            if now.adequate(self.settings.level) or not self.settings.adequacy:
                break
        if current is not base:
            # More seeds, for the sake of honest intervals.
            more = fit_model(self.question, current.effects, FINAL_SEEDS, start=(current,))
            current = joined_fit(current, more)
        after = self._adequacy(current)
        self._tell_adequacy("the model found", after)
        return self._conclude(base, current, before, after, alternatives)

    def _fit_well(self, effects: Sequence[Effect]) -> Fit:
        """A model on two seeds, and on a third where they do not agree."""
        fit = fit_model(self.question, effects, (0, 1))
        if fit.spread > 2.0:
            fit = joined_fit(fit, fit_model(self.question, effects, (2,), start=(fit,)))
        return fit

    def _round(
        self, current: Fit, pool: Sequence[Effect], number: int, adequate: bool
    ) -> tuple[Fit, Fit | None, list[Alternative]]:
        """Try one more effect: the model before (perhaps better fitted), the accepted model if
        any, and what explains the data about as well."""
        have = set(current.names)
        candidates = [e for e in pool if e.name not in have]
        excited = [e for e in candidates if not self.coverage.missing(e.needs)]
        for effect in candidates:
            if effect not in excited:
                lacks = ", ".join(self.coverage.missing(effect.needs))
                self._note(effect.name, number, math.nan, (), f"not excited: {lacks}")
        fresh = FRESH[adequate] if self.settings.from_prior else 0
        glances = self._each(excited, number, lambda e: glance(self.question, current, e, fresh))
        glances.sort(key=lambda g: -g.log_evidence)
        if number == 1 and pool is self.settings.catalogue:
            self.glances = glances
        chosen = [
            g.effect
            for g in glances[: self.settings.full_fits]
            if g.log_evidence > current.log_evidence + WORTH_FITTING[adequate]
        ]
        fits = self._each(
            chosen,
            number,
            lambda e: fit_model(self.question, (*current.effects, e), (0,), start=(current,)),
        )
        top = max((fit.log_evidence for fit in fits), default=-math.inf)
        near = [fit for fit in fits if fit.log_evidence > top - WITHIN]
        near = [
            joined_fit(fit, fit_model(self.question, fit.effects, (1,), start=(current,)))
            if fit.log_evidence > current.log_evidence
            else fit
            for fit in near
        ]
        near.sort(key=lambda fit: -fit.log_evidence)
        if self.settings.base_refit and near:
            again = fit_model(self.question, current.effects, (10,), start=(current, *near[:2]))
            current = joined_fit(current, again)
        for g in glances:
            full = next((f for f in (*near, *fits) if f.names[-1] == g.effect.name), None)
            gain = (g if full is None else full).log_evidence - current.log_evidence
            self._note(g.effect.name, number, gain, () if full is None else full.by_seed, "")
        if not near:
            return current, None, []
        best = near[0]
        gain = best.log_evidence - current.log_evidence
        accepted = gain >= self.settings.least_gain and min(best.by_seed) > current.log_evidence
        reason = f"gain {gain:.1f}"
        if accepted and gain < SURE:
            own, base = (held_out_scores(self.question, fit) for fit in (best, current))
            bound = lower_bound(own - base, stream(self.settings.seed, 77, number))
            reason += f", held-out gain at least {bound:+.2f} a transition"
            accepted = bound > 0
        outcome = f"{'accepted' if accepted else 'rejected'}: {reason}"
        self.candidates = [
            replace(c, outcome=outcome) if (c.name, c.round) == (best.names[-1], number) else c
            for c in self.candidates
        ]
        self.tell(f"round {number}: {best.names[-1]} {outcome}")
        close = [
            Alternative(
                fit.names,
                fit.log_evidence - current.log_evidence,
                "; or ".join(MOTIONS.get(need, need) for need in fit.effects[-1].needs),
            )
            for fit in near[1:]
            if fit.log_evidence > best.log_evidence - AMBIGUOUS
        ]
        return current, best if accepted else None, close

    def _each(
        self, effects: Sequence[Effect], number: int, work: Callable[[Effect], Result]
    ) -> list[Result]:
        """Do something with every candidate; one that fails costs no other."""
        done = []
        for effect in effects:
            try:
                done.append(work(effect))
            except Exception as error:
                reason = f"{effect.name} failed in round {number}: {type(error).__name__}: {error}"
                self.notes.append(" ".join(reason.split()))
                self.tell(f"warning: {self.notes[-1]}")
        return done

    def _pruned(self, fit: Fit) -> Fit:
        """The model without earlier effects that it no longer needs."""
        own = fit.effects[len(self.given) :]
        for effect in own[:-1]:
            less = tuple(e for e in fit.effects if e is not effect)
            other = fit_model(self.question, less, (0, 1), start=(fit,))
            if fit.log_evidence - other.log_evidence < self.settings.least_gain:
                self.tell(f"{effect.name} is no longer needed")
                fit = other
        return fit

    def _adequacy(self, fit: Fit) -> Adequacy:
        return check_adequacy(self.question, fit, stream(self.settings.seed, 78))

    def _conclude(
        self,
        base: Fit,
        final: Fit,
        before: Adequacy,
        after: Adequacy,
        alternatives: list[Alternative],
    ) -> Diagnosis:
        belief, first = (posterior(self.question, fit) for fit in (final, base))
        effects = named_effects(belief, len(self.given))
        missing = self.settings.adequacy and not after.adequate(self.settings.level)
        formulas = {formula.name for formula in FORMULAS}
        verdict: Verdict
        told = " and ".join(effect.sentence for effect in effects)
        if missing:
            verdict = "unknown_remains"
            cell = after.cells[0]
            where = f"{after.unexplained:.0%} of the transitions are not explained"
            if after.cells_p <= self.settings.level:
                where += f"; most of it in {cell.channel} ({cell.covariate}) while {cell.mode}"
            sentence = f"something else is missing: {where}" + (
                f"; besides, {told}" if told else ""
            )
        elif not effects:
            verdict, sentence = "nothing_missing", "the model explains the data; nothing is missing"
        elif any(effect.name in formulas for effect in effects):
            verdict, sentence = "formula", told
        elif alternatives:
            verdict = "ambiguous"
            others = " or ".join(" + ".join(a.names) for a in alternatives)
            sentence = f"{told}; {others} would explain the data as well"
        else:
            verdict, sentence = "named", told
        generator = stream(self.settings.seed, 79)
        gap, share = [], math.nan
        if effects:
            if self.fresh:
                errors = [prediction_errors(self.question, f, self.fresh) for f in (base, final)]
            else:
                errors = [held_out_errors(self.question, f, self.episodes) for f in (base, final)]
            gap, share = gaps(errors[0], errors[1], generator)
        self.tell(f"verdict: {verdict.replace('_', ' ')}: {sentence}")
        return Diagnosis(
            verdict=verdict,
            sentence=sentence,
            effects=effects,
            alternatives=tuple(alternatives) if effects else (),
            candidates=tuple(self.candidates),
            log_evidence_base=base.log_evidence,
            log_evidence=final.log_evidence,
            gap=tuple(gap),
            share_closed=share,
            held_out="fresh episodes" if self.fresh else "blocks held out",
            cells_before=before.cells,
            cells_after=after.cells,
            unexplained_before=before.unexplained,
            unexplained_after=after.unexplained,
            theta_before=theta_estimates(first),
            theta_after=theta_estimates(belief),
            detection_limits=detection_limits(
                self.glances, self.settings.catalogue, self.coverage, self.settings.least_gain
            ),
            coverage=dict(self.coverage.counts),
            notes=tuple(self.notes),
            seconds=time.perf_counter() - self.started,
            belief=belief,
            belief_before=first,
        )

    def _stop(self, reason: str) -> Diagnosis:
        self.tell(f"verdict: not enough information: {reason}")
        return Diagnosis(
            "not_enough_information",
            reason,
            coverage=dict(self.coverage.counts),
            seconds=time.perf_counter() - self.started,
        )

    def _note(
        self, name: str, number: int, gain: float, by_seed: tuple[float, ...], outcome: str
    ) -> None:
        self.candidates.append(Candidate(name, number, gain, by_seed, outcome))

    def _tell_adequacy(self, what: str, found: Adequacy) -> None:
        word = "explains the data" if found.adequate(self.settings.level) else "leaves something"
        top = found.cells[0] if found.cells else None
        where = (
            f"; largest: {top.channel} ({top.covariate}) while {top.mode}, {top.score:+.1f} sd"
            if top
            else ""
        )
        self.tell(f"{what} {word}: {found.unexplained:.0%} of the transitions unexplained{where}")
