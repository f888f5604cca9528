"""Formulas in place of effects."""

from __future__ import annotations

import pytest
import torch

from tpcd.belief.cloud import SamplerSettings
from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy import rivals
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.evidence import Fit, Question, fit_model
from tpcd.discrepancy.naming import Workbench
from tpcd.discrepancy.rivals import outdone
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.search import DiagnosisSettings
from tpcd.effects import Effect, find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

MUG = builtin_outlines()["mug"]
SETTINGS = DiagnosisSettings(
    sampler=SamplerSettings(
        particles=100, draws=400, prior_draws=100, fresh_modes=12, modes=6, rounds=2, places=24
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
        ("quasistatic", {"wall_friction": {"log_ratio": -0.6}}, WALL),
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
    assert outdone(bench, base, current, True).effects == (found,)
    if found is FIELD:
        (told_of,) = bench.candidates
        assert told_of.name == FIELD.name and told_of.gain > SETTINGS.least_gain
        assert "accepted in place of wall_friction" in told_of.outcome
        assert any(told_of.outcome in line for line in told)


@pytest.mark.parametrize(
    ("effects", "lead", "taken"),
    [
        (("wall_friction",), 5.9, False),
        (("wall_friction",), 6.1, True),
        (("wall_friction", "directional_friction"), 0.1, True),
        (("wall_friction", "directional_friction"), -0.1, False),
        (("wall_friction", "force_bias"), 5.9, False),
        (("force_bias",), 100.0, False),  # no formula is of its site
        ((), 100.0, False),
    ],
)
def test_a_formula_counts_for_two_effects(
    effects: tuple[str, ...], lead: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(recorded("quasistatic", {}), [])
    prior = bench.question.scene

    def fit(names: tuple[str, ...], evidence: float) -> Fit:
        own = tuple(find_effect(name) for name in names)
        return Fit(own, bench.question.step, prior, (evidence,), ())

    def fitted(question: Question, own, *_, **__) -> Fit:
        return fit(tuple(effect.name for effect in own), 100.0 + lead)

    monkeypatch.setattr(rivals, "fit_model", fitted)
    monkeypatch.setattr(rivals, "fitted_again", lambda bench, fit, *_: fit)
    monkeypatch.setattr(rivals, "pruned", lambda bench, fit: fit)
    seen = Glance(FIELD, 100.0, (0.1,), torch.zeros(9))
    monkeypatch.setattr(rivals, "glance", lambda question, base, effect, fresh: seen)
    current = fit(effects, 100.0)
    after = outdone(bench, fit((), 50.0), current, True)
    assert (FIELD.name in after.names) == taken
    assert ("force_bias" in after.names) == ("force_bias" in effects)
    if not taken:
        assert after is current


@pytest.mark.parametrize(("explained", "found"), [(True, "force_bias"), (False, WAVE.name)])
def test_where_something_is_left_every_formula_is_asked_in_place_of_all_effects(
    explained: bool, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No formula is of the site of the effect; the quick look sees none that is worth a fit."""
    bench = bench_of(recorded("quasistatic", {}), [])
    evidence = {(WAVE.name,): 120.0, (STEP.name,): 110.0}

    def fit(own: tuple[Effect, ...], value: float) -> Fit:
        return Fit(own, bench.question.step, bench.question.scene, (value,), ())

    def fitted(question: Question, own, *_, **__) -> Fit:
        return fit(tuple(own), evidence[tuple(effect.name for effect in own)])

    def look(question: Question, base: Fit, effect: Effect, fresh: int) -> Glance:
        return Glance(effect, 40.0 if effect in (WAVE, STEP) else 30.0, (0.1,), torch.zeros(9))

    monkeypatch.setattr(rivals, "fit_model", fitted)
    monkeypatch.setattr(rivals, "fitted_again", lambda bench, fit, *_: fit)
    monkeypatch.setattr(rivals, "pruned", lambda bench, fit: fit)
    monkeypatch.setattr(rivals, "glance", look)
    after = outdone(bench, fit((), 50.0), fit((find_effect("force_bias"),), 100.0), explained)
    assert after.names == (found,)
    assert [c.name for c in bench.candidates] == ([] if explained else [STEP.name, WAVE.name])
