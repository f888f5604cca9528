"""Which effects are tried at which stage of a diagnosis."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from diagnosis_bench import CATALOGUE, SETTINGS, bench_of, far_from_the_wall

from tpcd.belief.cloud import start_cloud
from tpcd.data.episode import Episode
from tpcd.discrepancy import bases, closeness, promises, pruning, search, workbench
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.settings import CLOSER
from tpcd.discrepancy.variants import strained
from tpcd.discrepancy.workbench import Close, Round, Workbench
from tpcd.effects import find_effect
from tpcd.effects.formula import FORMULAS
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape


@pytest.fixture(scope="module")
def episode() -> Episode:
    return far_from_the_wall()


def test_the_catalogue_is_asked_once_more_beside_a_formula(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[tuple[str, ...], int]] = []
    effect, formula = CATALOGUE[1], FORMULAS[0]

    def named(bench: Workbench, current: Fit, pool, adequate: bool) -> Round:
        asked.append((current.names, len(pool)))
        if current.effects:
            return Round(current)
        close = (Close(fit_model(bench.question, CATALOGUE[:1], (0,)), 1.0),)
        return Round(current, fit_model(bench.question, (effect,), (0,)), close)

    def swapped(bench: Workbench, base: Fit, current: Fit, explained: bool) -> Round:
        assert base.effects == () and explained
        if current.effects == (formula,):
            return Round(current)
        assert current.effects == (effect,)
        return Round(current, fit_model(bench.question, (formula,), (0,)))

    monkeypatch.setattr(search, "name_one", named)
    monkeypatch.setattr(search, "outdone", swapped)
    for module in (search, pruning):
        monkeypatch.setattr(module, "needless", lambda *_: [])
    monkeypatch.setattr(search, "better_base", lambda bench, current, *_: (current, None))
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: Adequacy(0.01, 0.5, 0.5, ()))
    found = search._search(bench_of(episode), ())
    size = len(CATALOGUE)
    assert asked == [((), size), ((effect.name,), size), ((formula.name,), size)]
    assert found.final.effects == (formula,) and found.base.effects == () and found.close == ()


def test_an_effect_that_the_data_do_not_excite_is_looked_at_and_gains_nothing(episode) -> None:
    bench = bench_of(episode)
    base = fit_model(bench.question, (), (0, 1))
    wall_friction = CATALOGUE[1]
    (look,) = promises.looks_at(bench, base, [wall_friction], 1, 40)
    with_it = fit_model(bench.question, (wall_friction,), (0, 1), start=(base,))
    gains = [one.log_evidence - base.log_evidence for one in (look, with_it)]
    assert max(gains) < 2.0 < SETTINGS.least_gain  # a look is Laplace's approximation
    assert abs(gains[1]) < 1.0


@pytest.mark.parametrize(
    ("shape", "numerics", "rival", "chosen"),
    [
        (12.0, 0.0, 10.0, "wide_shape"),
        (9.0, 0.0, 10.0, None),
        (5.0, 0.0, None, None),
        (0.0, 12.0, 10.0, None),
        (0.0, 17.0, 10.0, "relaxed_friction"),
    ],
)
def test_another_shape_need_only_be_as_good_as_an_effect(
    shape: float, numerics: float, rival: float | None, chosen: str | None, episode, monkeypatch
) -> None:
    """Gains over the base model; 6 is asked for."""
    bench = bench_of(episode)
    question = bench.question

    def fit(gain: float) -> Fit:
        return Fit((), question.step, question.scene, 2 * (100.0 + gain,), ())

    def fitted(asked: Question, *_, **__) -> Fit:
        if asked.step.friction == "anitescu":
            return fit(numerics)
        return fit(0.0 if asked.step != question.step else shape)

    monkeypatch.setattr(bases, "fit_model", fitted)
    monkeypatch.setattr(Workbench, "adequacy", lambda *_: Adequacy(0.3, 1e-9, 0.5, ()))
    monkeypatch.setattr(bases, "fit_well", lambda bench, *_, **__: fitted(bench.question))
    monkeypatch.setattr(bases, "fitted_again", lambda bench, fit, *_, **__: fit)
    base, best = fit(0.0), None if rival is None else fit(rival)
    _, found = bases.better_base(bench, base, best, False)
    assert (None if found is None else found[0].name) == chosen
    outcomes = {c.name: c.outcome for c in bench.candidates if c.round == 0}
    assert outcomes == {n: "accepted" if n == chosen else "" for n in outcomes} and outcomes
    # What does not win again, or not over a base model fitted again, is not taken.
    monkeypatch.setattr(bases, "fit_well", lambda *_, **__: fit(5.9))
    assert bases.better_base(bench, base, best, False)[1] is None
    monkeypatch.setattr(bases, "fit_well", lambda bench, *_, **__: fitted(bench.question))
    monkeypatch.setattr(bases, "fitted_again", lambda *_, **__: fit(50.0))
    assert bases.better_base(bench, base, best, False)[1] is None
    assert len(bench.candidates) == len(outcomes)
    assert SETTINGS.least_gain == 6.0


@pytest.mark.parametrize(("score", "strains"), [(2.5, False), (3.5, True)])
def test_an_outline_error_beyond_its_prior_strains_a_model(
    score: float, strains: bool, episode: Episode
) -> None:
    """Of two particles; the one without weight does not count."""
    bench = bench_of(episode)
    positions = torch.zeros(2, 8, dtype=torch.float64)
    positions[:, -1] = torch.tensor([score, 60.0])
    cloud = replace(start_cloud(positions), weights=torch.tensor([1.0, 0.0], dtype=torch.float64))
    fit = Fit((), bench.question.step, bench.question.scene, (0.0,), (cloud,))
    assert strained(fit) is strains


@pytest.mark.parametrize("strains", [False, True])
def test_another_shape_is_asked_for_where_the_outline_error_is_strained(
    strains: bool, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the model explains the data and no effect does so better."""
    asked: list[bool] = []

    def better(bench: Workbench, current: Fit, rival: Fit | None, explained: bool):
        assert rival is None
        asked.append(explained)
        return current, None

    explains = Adequacy(0.01, 0.5, 0.5, ())
    monkeypatch.setattr(search, "name_one", lambda bench, current, *_: Round(current))
    monkeypatch.setattr(search, "better_base", better)
    monkeypatch.setattr(bases, "strained", lambda fit: strains)
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: explains)
    search._search(bench_of(episode), ())
    assert asked == [True] * strains


def test_what_came_close_is_asked_with_the_next_effect_too(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drift and a tilt came close to a bias; beside a soft floor the drift still does."""
    bench = bench_of(episode)
    evidence = {"force_drift": 98.0, "floor_tilt": 96.9, "wall_tilt": math.nan}

    def fit(names: tuple[str, ...], value: float) -> Fit:
        own = tuple(find_effect(name) for name in names)
        return Fit(own, bench.question.step, bench.question.scene, (value,), ())

    def fitted(question: Question, effects, *_, **__) -> Fit:
        if effects[0].name == "wall_tilt":
            raise ValueError("no draw at all")
        return fit(tuple(e.name for e in effects), evidence[effects[0].name])

    monkeypatch.setattr(closeness, "fit_model", fitted)
    before = [Close(fit((name,), 50.0), 9.0) for name in (*evidence, "floor_compliance")]
    kept = closeness.carried_on(bench, before, fit(("force_bias", "floor_compliance"), 100.0))
    assert [one.fit.names for one in kept] == [("force_drift", "floor_compliance")]
    assert kept[0].gain == pytest.approx(48.0)
    assert bench.notes == ["wall_tilt failed beside floor_compliance: ValueError: no draw at all"]


def test_a_search_from_where_the_model_arrived_alone_stays_so_when_it_looks_closer(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    question = search._question(
        [episode], PolygonShape(builtin_outlines()["mug"]), replace(SETTINGS, from_prior=False),
        Memory(),
    )  # fmt: skip
    bench = replace(bench_of(episode), question=question)
    asked: list[Question] = []

    def again(bench: Workbench, fit: Fit, seed: int, start, question: Question) -> Fit:
        asked.append(question)
        return fit

    monkeypatch.setattr(workbench, "fitted_again", again)
    fit = Fit((), question.step, question.scene, (1.0,), ())
    workbench.looked_closer(bench, fit, [fit])
    assert len(asked) == 2  # once: nothing climbs
    assert all(one.sampler.fresh_modes == one.sampler.flat_climbers == CLOSER for one in asked)
