"""Formulas in place of effects."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import SamplerSettings
from tpcd.data.episode import Episode
from tpcd.discrepancy import rivals, workbench
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.rivals import outdone
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.search import DiagnosisSettings
from tpcd.discrepancy.workbench import Round, Workbench
from tpcd.effects import Effect, find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

MUG = builtin_outlines()["mug"]
SETTINGS = DiagnosisSettings(
    sampler=SamplerSettings(
        particles=100,
        draws_per_place=9,
        draws=400,
        prior_draws=100,
        fresh_modes=12,
        modes=6,
        rounds=2,
        places=24,
    ),
    catalogue=(find_effect("wall_friction"), find_effect("floor_tilt")),
)
STEPS = 40
FIELD, WALL = find_effect("log_friction ~ place"), find_effect("wall_friction")
STEP, WAVE = find_effect("floor_height ~ step"), find_effect("floor_height ~ wave")


def recorded(kind: str, hidden: dict[str, dict[str, float]]) -> Episode:
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", MUG.vertices, generator)
    motion = make_motion("diagnosis", scene, STEPS, generator)
    truth = make_truth(scene, kind, hidden, STEPS)
    return record(truth, scene, motion, STEPS, generator).measured


def bench_of(episode: Episode, told: list[str]) -> Workbench:
    shape = PolygonShape(MUG)
    question = Question(
        joined_history([episode]), make_prior(shape), MisfitField(0.0), StepSettings(),
        SETTINGS.sampler,
    )  # fmt: skip
    return Workbench(question, SETTINGS, coverage_of([episode]), 0, told.append)


@pytest.mark.parametrize(
    ("kind", "hidden", "found"),
    [
        ("mujoco", {"friction_field": {"slope": 6.0}}, FIELD),
        pytest.param(
            "quasistatic", {"wall_friction": {"log_ratio": -0.6}}, WALL, marks=pytest.mark.slow
        ),
    ],
)
def test_a_law_of_place_takes_the_place_of_another_wall_and_not_of_a_true_one(
    kind: str, hidden: dict[str, dict[str, float]], found: Effect
) -> None:
    told: list[str] = []
    bench = bench_of(recorded(kind, hidden), told)
    base = fit_model(bench.question, (), (0, 1))
    current = fit_model(bench.question, (WALL,), (0, 1), start=(base,))
    assert current.log_evidence > base.log_evidence + SETTINGS.least_gain  # either would be named
    round_ = outdone(bench, base, current, True)
    assert (round_.best or round_.base).effects == (found,) and round_.close == ()
    if found is FIELD:
        (told_of,) = bench.candidates
        assert told_of.name == FIELD.name and told_of.gain > SETTINGS.least_gain
        assert "accepted in place of wall_friction" in told_of.outcome
        assert any(told_of.outcome in line for line in told)


class Stand:
    """Fits and looks with evidence that is made up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, given: int = 0) -> None:
        bench = bench_of(recorded("quasistatic", {}), [])
        self.bench = replace(bench, given=given)
        self.evidence: dict[tuple[str, ...], float] = {}
        self.looks: dict[tuple[str, ...], float] = {}
        self.refitted: dict[tuple[str, ...], float] = {}
        self.adequate = True
        monkeypatch.setattr(rivals, "fit_model", self.fitted)
        monkeypatch.setattr(rivals, "looked_closer", self.closer)
        monkeypatch.setattr(rivals, "pruned", lambda bench, fit: fit)
        monkeypatch.setattr(rivals, "glance", self.look)
        monkeypatch.setattr(workbench, "lower_bound", lambda *_: 1.0)
        monkeypatch.setattr(workbench, "held_out_scores", lambda *_: torch.zeros(5))
        monkeypatch.setattr(Workbench, "adequacy", self.left)

    def fit(self, names: tuple[str, ...], value: float) -> Fit:
        own = tuple(find_effect(name) for name in names)
        return Fit(own, self.bench.question.step, self.bench.question.scene, (value, value), ())

    def fitted(self, question: Question, own, *_, **__) -> Fit:
        names = tuple(effect.name for effect in own)
        return self.fit(names, self.evidence.get(names, 0.0))

    def closer(self, bench: Workbench, current: Fit, near: list[Fit], seeds) -> tuple:
        def again(fit: Fit) -> Fit:
            return self.fit(fit.names, self.refitted.get(fit.names, fit.log_evidence))

        return again(current), [again(fit) for fit in near]

    def look(self, question: Question, base: Fit, effect: Effect, fresh: int, *_) -> Glance:
        found = self.looks.get((*base.names, effect.name), 30.0)
        return Glance(found, (0.1,), torch.zeros(9), torch.eye(9), torch.zeros(0, 9), effect)

    def left(self, fit: Fit) -> Adequacy:
        return Adequacy(0.01, 0.5, 0.5, ()) if self.adequate else Adequacy(0.3, 1e-9, 0.5, ())

    def ask(self, effects: tuple[str, ...], explained: bool = True) -> Round:
        base = self.fit(effects[: self.bench.given], 50.0)
        return outdone(self.bench, base, self.fit(effects, 100.0), explained)


@pytest.mark.parametrize(
    ("effects", "left", "lead", "taken"),
    [
        (("wall_friction",), (), 5.9, False),
        (("wall_friction",), (), 6.1, True),
        (("wall_friction", "directional_friction"), (), 0.1, True),
        (("wall_friction", "directional_friction"), (), -0.1, False),
        (("wall_friction", "force_bias"), ("force_bias",), 5.9, False),
        (("wall_friction", "force_bias"), ("force_bias",), 6.1, True),
        (("wall_friction", "load_friction"), ("load_friction",), 6.1, True),
        (("wall_friction", "load_friction"), ("load_friction",), 5.9, False),
        (("force_bias",), (), 100.0, False),  # no formula is of its site
        ((), (), 100.0, False),
    ],
)
def test_a_formula_counts_for_two_effects(
    effects: tuple[str, ...], left: tuple[str, ...], lead: float, taken: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    stand = Stand(monkeypatch)
    stand.evidence = {(*left, FIELD.name): 100.0 + lead}
    stand.looks = {(*left, FIELD.name): 100.0}
    found = stand.ask(effects)
    assert (found.best is not None) == taken
    assert found.base.names == effects
    if found.best is not None:
        assert found.best.names == (*left, FIELD.name)


@pytest.mark.parametrize("effects", [("force_bias",), ("force_bias", "payload")])
@pytest.mark.parametrize("explained", [True, False])
def test_where_something_is_left_every_formula_is_asked_in_place_of_all_effects(
    explained: bool, effects: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No formula is of the sites of the effects; the quick look sees none that is worth a fit."""
    stand = Stand(monkeypatch)
    stand.evidence = {(WAVE.name,): 120.0, (STEP.name,): 110.0}
    stand.looks = dict.fromkeys(stand.evidence, 40.0)
    found = stand.ask(effects, explained)
    assert (found.best is not None) == (not explained)
    assert [c.name for c in stand.bench.candidates] == ([] if explained else [STEP.name, WAVE.name])


def test_what_was_found_is_fitted_again_before_it_gives_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stand = Stand(monkeypatch)
    stand.evidence, stand.looks = {(FIELD.name,): 140.0}, {(FIELD.name,): 120.0}
    stand.refitted = {(WALL.name,): 138.0}
    found = stand.ask((WALL.name,))
    assert found.best is None and found.base.log_evidence == pytest.approx(138.0)
    assert found.close == ()


@pytest.mark.parametrize(("lead", "closer"), [(0.9, False), (1.1, True)])
def test_a_formula_that_misses_its_price_by_much_is_not_looked_at_more_closely(
    lead: float, closer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has to gain 6 nats more than the effect, and would gain 50 if it were."""
    stand = Stand(monkeypatch)
    stand.evidence, stand.looks = {(FIELD.name,): 100.0 + lead}, {(FIELD.name,): 100.0}
    stand.refitted = {(FIELD.name,): 150.0}
    assert (stand.ask((WALL.name,)).best is not None) == closer


@pytest.mark.parametrize(
    ("lead", "best", "close"),
    [(2.9, WALL, None), (3.1, WALL, FIELD), (8.9, FIELD, WALL), (9.1, FIELD, None)],
)
def test_what_comes_close_is_told(
    lead: float, best: Effect, close: Effect | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within 3 nats of the 6 that are asked."""
    stand = Stand(monkeypatch)
    stand.evidence, stand.looks = {(FIELD.name,): 100.0 + lead}, {(FIELD.name,): 100.0 + lead}
    found = stand.ask((WALL.name,))
    assert (found.best or found.base).names == (best.name,)
    assert [one.fit.names for one in found.close] == ([(close.name,)] if close else [])


def test_a_formula_that_leaves_something_takes_the_place_of_nothing_that_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stand = Stand(monkeypatch)
    stand.evidence, stand.looks = {(FIELD.name,): 140.0}, {(FIELD.name,): 120.0}
    stand.adequate = False
    assert stand.ask((WALL.name,)).best is None
    stand.adequate = True
    assert stand.ask((WALL.name,)).best is not None


def test_what_gives_way_stays_in_the_report_and_what_was_asked_beside_it_goes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stand = Stand(monkeypatch)
    stand.evidence, stand.looks = {(FIELD.name,): 140.0}, {(FIELD.name,): 120.0}
    stand.bench.candidates[:] = [
        Candidate(WALL.name, 1, 50.0, (), "accepted: gain 50.0"),
        Candidate("floor_tilt", 2, 1.0, (), "rejected: gain 1.0"),
    ]
    stand.ask((WALL.name,))
    first, second = stand.bench.candidates
    assert first.outcome == f"accepted: gain 50.0; gave way to {FIELD.name}"
    assert (second.name, second.round) == (FIELD.name, 1)


def test_effects_that_were_given_are_kept_and_asked_of_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stand = Stand(monkeypatch, given=1)
    stand.evidence = {(STEP.name, WAVE.name): 200.0, (STEP.name, STEP.name): 300.0}
    stand.looks = {(STEP.name, STEP.name): 150.0, (STEP.name, WAVE.name): 140.0}
    found = stand.ask((STEP.name, "floor_tilt"))
    assert found.best is not None and found.best.names == (STEP.name, WAVE.name)


def test_evidence_that_is_no_number_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    stand = Stand(monkeypatch)
    stand.evidence = {(STEP.name,): math.nan, (WAVE.name,): 140.0}
    stand.looks = {(STEP.name,): 150.0, (WAVE.name,): 140.0}
    found = stand.ask(("floor_tilt",), explained=False)
    assert found.best is not None and found.best.names == (WAVE.name,)


def test_a_formula_that_fails_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stand = Stand(monkeypatch)
    stand.looks = {(FIELD.name,): 120.0}

    def failing(*_, **__) -> Fit:
        raise RuntimeError("no such luck")

    monkeypatch.setattr(rivals, "fit_model", failing)
    found = stand.ask((WALL.name, "force_bias"), explained=False)
    assert found.best is None and found.base.names == (WALL.name, "force_bias")
    assert any("no such luck" in note for note in stand.bench.notes)
