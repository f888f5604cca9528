"""Which effects are tried at which stage of a diagnosis."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tpcd.belief.cloud import start_cloud
from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy import naming, promises, search, workbench
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import FIT_SAMPLER, Fit, Question
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.nested import NestedGain
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.search import DiagnosisSettings
from tpcd.discrepancy.settings import BEATEN, CLOSER
from tpcd.discrepancy.variants import strained
from tpcd.discrepancy.workbench import Close, Round, Workbench
from tpcd.effects import find_effect
from tpcd.effects.formula import FORMULAS
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

CATALOGUE = tuple(find_effect(n) for n in ("floor_compliance", "wall_friction", "wall_tilt"))
SETTINGS = DiagnosisSettings(
    sampler=replace(
        FIT_SAMPLER,
        particles=60,
        draws_per_place=9,
        draws=200,
        prior_draws=100,
        fresh_modes=10,
        modes=4,
        rounds=1,
        places=20,
    ),
    catalogue=CATALOGUE,
)


@pytest.fixture(scope="module")
def episode():
    """Steps that never slide along the wall."""
    generator = torch.Generator().manual_seed(5)
    outline = builtin_outlines()["mug"].vertices
    scene = replace(draw_scene("mug", outline, generator), wall_position=2.0)
    truth = make_truth(scene, "quasistatic")
    motion = make_motion("rich", scene, 16, generator)
    found = record(truth, scene, motion, 16, generator).measured
    assert coverage_of([found]).missing(find_effect("wall_friction").needs)
    return found


def bench_of(episode: Episode) -> Workbench:
    question = Question(
        joined_history([episode]), make_prior(PolygonShape(builtin_outlines()["mug"])),
        MisfitField(0.0), StepSettings(), SETTINGS.sampler,
    )  # fmt: skip
    return Workbench(question, SETTINGS, coverage_of([episode]), 0, lambda line: None)


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

    monkeypatch.setattr(naming, "fit_model", fitted)
    monkeypatch.setattr(Workbench, "adequacy", lambda *_: Adequacy(0.3, 1e-9, 0.5, ()))
    monkeypatch.setattr(naming, "fit_well", lambda bench, *_, **__: fitted(bench.question))
    monkeypatch.setattr(naming, "fitted_again", lambda bench, fit, *_, **__: fit)
    base, best = fit(0.0), None if rival is None else fit(rival)
    _, found = naming.better_base(bench, base, best, False)
    assert (None if found is None else found[0].name) == chosen
    outcomes = {c.name: c.outcome for c in bench.candidates if c.round == 0}
    assert outcomes == {n: "accepted" if n == chosen else "" for n in outcomes} and outcomes
    # What does not win again, or not over a base model fitted again, is not taken.
    monkeypatch.setattr(naming, "fit_well", lambda *_, **__: fit(5.9))
    assert naming.better_base(bench, base, best, False)[1] is None
    monkeypatch.setattr(naming, "fit_well", lambda bench, *_, **__: fitted(bench.question))
    monkeypatch.setattr(naming, "fitted_again", lambda *_, **__: fit(50.0))
    assert naming.better_base(bench, base, best, False)[1] is None
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
    monkeypatch.setattr(search, "strained", lambda fit: strains)
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

    monkeypatch.setattr(search, "fit_model", fitted)
    before = [Close(fit((name,), 50.0), 9.0) for name in (*evidence, "floor_compliance")]
    kept = search._carried_on(bench, before, fit(("force_bias", "floor_compliance"), 100.0))
    assert [one.fit.names for one in kept] == [("force_drift", "floor_compliance")]
    assert kept[0].gain == pytest.approx(48.0)
    assert bench.notes == ["wall_tilt failed beside floor_compliance: ValueError: no draw at all"]


def looks_of(worth: dict[str, float]) -> list[Glance]:
    """Looks that find such log evidences, or 60."""
    one = torch.eye(1)
    return [Glance(worth.get(e.name, 60.0), (1.0,), one[0], one, e) for e in CATALOGUE]


@pytest.mark.parametrize(
    ("looks", "draws", "std", "adequate", "fitted"),
    [
        ((1.5, -4.0, -4.0), (-2.0, -4.0, -4.0), 0.1, True, 0),  # draws know better than a look
        ((1.5, -4.0, -4.0), (-2.0, -4.0, -4.0), 0.9, True, 1),  # but not where they are few
        ((-4.0, -4.0, -4.0), (0.5, -4.0, -4.0), 0.1, True, 0),
        ((-4.0, -4.0, -4.0), (0.5, -4.0, -4.0), 0.1, False, 1),
        ((-4.0, -4.0, -4.0), (-4.0, -4.0, 2.0), 0.1, True, 1),
        ((8.0, -4.0, -4.0), (-9.0, -4.0, -4.0), 0.1, True, 1),  # what takes the scene elsewhere
    ],
)
def test_what_does_not_promise_to_gain_is_not_fitted(
    looks, draws, std: float, adequate: bool, fitted: int, episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gains by looks beside that at the model itself, and by draws of the model."""
    bench = bench_of(episode)
    names = [effect.name for effect in CATALOGUE]
    given = looks_of({n: 100.0 + gain for n, gain in zip(names, looks, strict=True)})
    by_draws = dict(zip(names, draws, strict=True))
    asked: list[str] = []

    def fit(question: Question, effects, seeds, *_, **__) -> Fit:
        asked.append(effects[-1].name)
        return Fit(tuple(effects), question.step, question.scene, (107.0,), ())

    monkeypatch.setattr(naming, "looks_at", lambda *_: given)
    monkeypatch.setattr(promises, "peak", lambda *_: looks_of({names[0]: 100.0})[0])
    monkeypatch.setattr(
        promises, "nested_gain", lambda *a: NestedGain(by_draws[a[-1].effect.name], std)
    )
    monkeypatch.setattr(naming, "fit_model", fit)
    monkeypatch.setattr(naming, "fitted_again", lambda bench, fit, *_, **__: fit)
    monkeypatch.setattr(naming, "looked_closer", lambda bench, current, near: (current, near))
    base = Fit((), bench.question.step, bench.question.scene, (107.0,), ())
    found = naming.name_one(bench, base, CATALOGUE, adequate)
    assert len(asked) == fitted and found.best is None
    noted = {c.name: c.gain for c in bench.candidates}
    for name, look in zip(names, looks, strict=True):
        promised = max(look, by_draws[name])
        if std < 0.5 and look < by_draws[name] + 4:
            promised = by_draws[name]
        expected = 0.0 if name in asked else promised
        assert noted[name] == pytest.approx(expected)


def test_what_looks_far_worse_than_a_full_fit_gets_none(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second looks less than `BEATEN` below what the first is worth, the third more."""
    bench = bench_of(episode)
    worth = dict(zip((e.name for e in CATALOGUE), (100.0, 80.0, 70.0), strict=True))
    looks = looks_of(worth)
    fitted: list[str] = []

    def fit(question: Question, effects, seeds, *_, **__) -> Fit:
        fitted.extend(effect.name for effect in effects)
        return Fit(tuple(effects), question.step, question.scene, (worth[fitted[-1]],), ())

    monkeypatch.setattr(naming, "looks_at", lambda *_: looks)
    monkeypatch.setattr(promises, "peak", lambda *_: looks_of({})[0])
    monkeypatch.setattr(promises, "nested_gain", lambda *_: NestedGain(-math.inf, math.inf))
    monkeypatch.setattr(naming, "fit_model", fit)
    monkeypatch.setattr(naming, "fitted_again", lambda bench, fit, *_, **__: fit)
    monkeypatch.setattr(naming, "looked_closer", lambda bench, current, near: (current, near))
    base = Fit((), bench.question.step, bench.question.scene, (60.0,), ())
    naming.name_one(bench, base, CATALOGUE, False)
    assert fitted == [effect.name for effect in CATALOGUE[:2]]
    assert 100.0 - 80.0 < BEATEN < 100.0 - 70.0
    # Where a full fit finds more than its look, another one may too.
    fitted.clear()
    looks[0] = replace(looks[0], log_evidence=90.0)
    naming.name_one(bench, base, CATALOGUE, False)
    assert fitted == [effect.name for effect in CATALOGUE]
    # And what draws promise keeps the last one in too, while the second, far below, stays out.
    by_draws = dict(zip(worth, (30.0, -5.0, 38.0), strict=True))
    monkeypatch.setattr(
        promises, "nested_gain", lambda *a: NestedGain(by_draws[a[-1].effect.name], 0.1)
    )
    looks[:] = looks_of(dict(zip(worth, (110.0, 61.0, 70.0), strict=True)))
    worth |= {name: 100.0 for name in worth}
    fitted.clear()
    naming.name_one(bench, base, CATALOGUE, False)
    assert fitted == [CATALOGUE[k].name for k in (0, 2)]


def test_nothing_that_was_not_weighed_comes_before_what_was(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The look at the best one promises too much; so do those at the others, as draws tell."""
    bench = bench_of(episode)
    names = [effect.name for effect in CATALOGUE]
    looks = looks_of(dict(zip(names, (101.5, 101.0, 99.0), strict=True)))
    asked: list[str] = []

    def weighed(question: Question, fit: Fit, look: Glance) -> NestedGain:
        asked.append(look.effect.name)
        return NestedGain(-2.0, 0.1)

    base = Fit((), bench.question.step, bench.question.scene, (100.0,), ())
    monkeypatch.setattr(promises, "WEIGHED", 1)
    monkeypatch.setattr(promises, "nested_gain", weighed)
    gains = promises.promised_gains(bench, base, looks, 1, 100.0)
    assert asked == names[:2]
    assert [gains[name] for name in names] == [-2.0, -2.0, -1.0]


def test_a_look_that_finds_more_than_the_fits_has_the_model_fitted_from_there(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    base = Fit((), bench.question.step, bench.question.scene, (100.0,), ())
    seen = looks_of({CATALOGUE[0].name: 121.0})[0]
    begun: list[torch.Tensor] = []

    def again(bench: Workbench, fit: Fit, *_, places: torch.Tensor) -> Fit:
        begun.append(places)
        return replace(fit, by_seed=(100.0, 120.0))

    monkeypatch.setattr(promises, "peak", lambda *_: seen)
    monkeypatch.setattr(promises, "fitted_again", again)
    fit, reached = promises.seen_itself(bench, base, 8)
    assert fit.log_evidence == 120.0 and reached == 121.0
    assert len(begun) == 1 and torch.equal(begun[0], seen.place[None])
    begun.clear()
    promises.seen_itself(bench, fit, 8)
    assert not begun


@pytest.mark.parametrize(
    ("draws", "std", "closer"),
    [(7.0, 0.4, 0), (4.5, 0.4, 1), (9.5, 0.4, 1), (7.0, 1.1, 1)],
)
def test_what_draws_and_fits_agree_about_is_not_looked_at_more_closely(
    draws: float, std: float, closer: int, episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gain of 7 is undecided by itself."""
    bench = bench_of(episode)
    asked: list[Fit] = []

    def look_closer(bench: Workbench, current: Fit, near: list[Fit]) -> tuple[Fit, list[Fit]]:
        asked.append(near[0])
        return current, near

    def fit(question: Question, effects, seeds, *_, **__) -> Fit:
        return Fit(tuple(effects), question.step, question.scene, (107.0, 107.0), ())

    looks = looks_of({CATALOGUE[0].name: 108.0})
    monkeypatch.setattr(naming, "looks_at", lambda *_: looks)
    monkeypatch.setattr(promises, "peak", lambda *_: looks_of({CATALOGUE[0].name: 100.0})[0])
    monkeypatch.setattr(promises, "nested_gain", lambda *_: NestedGain(draws, std))
    monkeypatch.setattr(naming, "fit_model", fit)
    monkeypatch.setattr(naming, "fitted_again", lambda bench, fit, *_, **__: fit)
    monkeypatch.setattr(naming, "looked_closer", look_closer)
    monkeypatch.setattr(naming, "stands", lambda *_: (False, ""))
    base = Fit((), bench.question.step, bench.question.scene, (100.0, 100.0), ())
    naming.name_one(bench, base, CATALOGUE[:1], True)
    assert len(asked) == closer


def test_where_no_look_at_the_model_itself_is_had_its_fits_stand_for_it(
    episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    base = Fit((), bench.question.step, bench.question.scene, (100.0,), ())

    def fails(*_) -> None:
        raise ValueError("no mode at all")

    monkeypatch.setattr(promises, "peak", fails)
    assert promises.seen_itself(bench, base, 8) == (base, 100.0)
    monkeypatch.setattr(promises, "nested_gain", fails)
    looks = looks_of({CATALOGUE[0].name: 103.0})
    gains = promises.promised_gains(bench, base, looks, 1, 100.0)
    assert gains[CATALOGUE[0].name] == 3.0
    assert any("the gain of floor_compliance by draws failed" in note for note in bench.notes)


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
