"""What effects promise to gain, and which of them are fitted in full."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from diagnosis_bench import CATALOGUE, bench_of, far_from_the_wall

from tpcd.data.episode import Episode
from tpcd.discrepancy import naming, promises
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.nested import NestedGain
from tpcd.discrepancy.screening import Glance
from tpcd.discrepancy.settings import BEATEN, FEW_DRAWS
from tpcd.discrepancy.workbench import Workbench


@pytest.fixture(scope="module")
def episode() -> Episode:
    return far_from_the_wall()


@pytest.fixture(autouse=True)
def worth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models are fitted with many draws, also those that are made up and have none."""
    monkeypatch.setattr(Fit, "worth", 100.0)


def looks_of(worth: dict[str, float]) -> list[Glance]:
    """Looks that find such log evidences, or 60."""
    one = torch.eye(1)
    return [Glance(worth.get(e.name, 60.0), (1.0,), one[0], one, one[:0], e) for e in CATALOGUE]


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
    monkeypatch.setattr(Workbench, "adequacy", lambda *_: Adequacy(0.1, 0.01, 0.01, ()))
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
    # Beside a model that rests on few draws looks are worth little, unless it leaves nothing.
    for adequate, count in ((False, 3), (True, 2)):
        fitted.clear()
        monkeypatch.setattr(Fit, "worth", FEW_DRAWS - 1.0)
        naming.name_one(bench, base, CATALOGUE, adequate)
        assert fitted == [effect.name for effect in CATALOGUE[:count]]
    monkeypatch.setattr(Fit, "worth", FEW_DRAWS)
    # A round that is made again takes the place of the one before.
    assert sorted(c.name for c in bench.candidates) == sorted(worth)
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
    monkeypatch.setattr(naming, "takes_the_place", lambda *_, **__: (False, ""))
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


@pytest.mark.parametrize(
    ("adequate", "p", "quick", "full"),
    [(False, 1e-6, 3, 1), (False, 0.01, 0, 0), (True, 0.5, 0, 0)],
)
def test_where_something_is_left_and_nothing_promises_a_gain_all_have_a_quick_fit(
    adequate: bool, p: float, quick: int, full: int, episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an effect that takes the scene far away looks and draws know nothing."""
    bench = bench_of(episode)
    begun: list[tuple[str, ...]] = []
    tried: list[str] = []

    def quickly(question: Question, effects, seeds, start, places, passes: int) -> Fit:
        tried.append(effects[-1].name)
        assert passes == 1 and question.sampler.draws == promises.QUICK["draws"]
        found = 109.0 if effects[-1] is CATALOGUE[1] else 99.0
        return Fit(tuple(effects), question.step, question.scene, (found,), ())

    def fit(question: Question, effects, seeds, start, **_) -> Fit:
        begun.append(tuple(one.names[-1] for one in start if one.names))
        return Fit(tuple(effects), question.step, question.scene, (100.0,), ())

    looks = looks_of({effect.name: 95.0 for effect in CATALOGUE})
    monkeypatch.setattr(naming, "looks_at", lambda *_: looks)
    monkeypatch.setattr(promises, "peak", lambda *_: looks_of({CATALOGUE[0].name: 99.0})[0])
    monkeypatch.setattr(promises, "nested_gain", lambda *_: NestedGain(-4.0, 0.1))
    monkeypatch.setattr(Workbench, "adequacy", lambda *_: Adequacy(0.1, p, p, ()))
    monkeypatch.setattr(promises, "fit_model", quickly)
    monkeypatch.setattr(naming, "fit_model", fit)
    monkeypatch.setattr(naming, "fitted_again", lambda bench, fit, *_, **__: fit)
    monkeypatch.setattr(naming, "looked_closer", lambda bench, current, near: (current, near))
    base = Fit((), bench.question.step, bench.question.scene, (100.0,), ())
    naming.name_one(bench, base, CATALOGUE, adequate)
    assert len(tried) == quick
    assert begun == [(CATALOGUE[1].name,)] * full
