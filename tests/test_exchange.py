"""What is tried in vain beside an effect may take its place."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from diagnosis_bench import CATALOGUE, bench_of, far_from_the_wall

from tpcd.data.episode import Episode
from tpcd.discrepancy import bases, exchange, naming, search
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.exchange import Exchanges, exchanged
from tpcd.discrepancy.fit import Fit
from tpcd.discrepancy.workbench import Close, Round, Workbench
from tpcd.effects import find_effect
from tpcd.effects.formula import FORMULAS
from tpcd.effects.protocol import Effect

FLOOR, WALL, TILT = CATALOGUE
BIAS = find_effect("force_bias")


@pytest.fixture(scope="module")
def episode() -> Episode:
    return far_from_the_wall()


def fit_of(bench: Workbench, effects: tuple[Effect, ...], value: float) -> Fit:
    """A made-up fit."""
    return Fit(effects, bench.question.step, bench.question.scene, (value,), ())


def answers(
    monkeypatch: pytest.MonkeyPatch, bench: Workbench, **values: tuple[float, ...]
) -> list[tuple]:
    """Fits have these log evidences by seed; returned is what was asked for, and from where."""
    made: list[tuple] = []

    def fitted(bench: Workbench, effects, start=()) -> Fit:
        made.append((tuple(e.name for e in effects), tuple(one.names for one in start)))
        by_seed = values["+".join(e.name for e in effects)]
        return replace(fit_of(bench, tuple(effects), 0.0), by_seed=by_seed)

    monkeypatch.setattr(exchange, "fit_well", fitted)
    leaves(monkeypatch)
    return made


def leaves(monkeypatch: pytest.MonkeyPatch, *something: tuple[str, ...]) -> None:
    """Every model explains the data but those with these effects."""

    def left(bench: Workbench, fit: Fit) -> Adequacy:
        return Adequacy(0.01, *(2 * (1e-9 if fit.names in something else 0.5,)), ())

    monkeypatch.setattr(Workbench, "adequacy", left)


def ask(
    bench: Workbench, current: Fit, tried: Fit | None, close=(), done=None, explained: bool = True
) -> Round:
    """Ask about an exchange, beside a model without effects that has 60."""
    without, done = fit_of(bench, (), 60.0), Exchanges() if done is None else done
    return exchanged(bench, current, tried, without, close, done, explained)


@pytest.mark.parametrize(
    ("value", "is_taken", "close"),
    [
        (114.0, True, []),  # 4 better: what was there is not even close
        (111.0, True, [("wall_friction",)]),
        (109.0, False, [("wall_tilt",)]),
        (106.0, False, []),
    ],
)
@pytest.mark.parametrize("before", [(), (108.5,)])
def test_what_explains_the_data_better_takes_the_place(
    value: float, is_taken: bool, close, before, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    bench.candidates += [
        Candidate("wall_friction", 1, 48.0, (108.0,), "accepted: gain 48.0"),
        Candidate("wall_tilt", 1, 30.0, (90.0,)),
        Candidate("wall_tilt", 2, 2.0, (112.0,), "rejected: gain 2.0"),
    ]
    current, tried = fit_of(bench, (WALL,), 110.0), fit_of(bench, (WALL, TILT), 112.0)
    made, done = answers(monkeypatch, bench, wall_tilt=(value, value)), Exchanges()
    # What came close before is the same model, worse fitted, and is told once at most.
    earlier = [Close(fit_of(bench, (TILT,), one), 48.5) for one in before if value > one]
    found = ask(bench, current, tried, earlier, done)
    assert made == [(("wall_tilt",), (("wall_friction", "wall_tilt"), ("wall_friction",)))]
    assert found.base is current and (found.best is not None) == is_taken
    assert [one.fit.names for one in found.close] == close
    # Gains are over the model without effects, as it is now.
    own = {c.name: c for c in bench.candidates if c.round == 1}
    assert len(bench.candidates) == (2 if is_taken else 3)
    assert own["wall_tilt"].gain == value - 60.0
    assert all(one.gain == one.fit.log_evidence - 60.0 for one in found.close)
    assert own["wall_tilt"].outcome.startswith("accepted" if is_taken else "rejected")
    assert own["wall_friction"].outcome.endswith("gave way to wall_tilt") == is_taken
    # What was asked beside an effect that goes is asked anew.
    assert any(c.round == 2 for c in bench.candidates) == (not is_taken)


def test_no_exchange_is_asked_about_twice_nor_undone(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, done = bench_of(episode), Exchanges()
    made = answers(monkeypatch, bench, wall_tilt=(114.0, 114.0), wall_friction=(300.0, 300.0))
    both = fit_of(bench, (WALL, TILT), 112.0)
    found = ask(bench, fit_of(bench, (WALL,), 110.0), both, done=done)
    assert found.best is not None
    back = fit_of(bench, (TILT, WALL), 200.0)
    assert ask(bench, found.best, back, done=done).best is None and len(made) == 1
    # Under another question it is.
    misfit = replace(bench.question.misfit, sd=1e-3)
    bench = replace(bench, question=replace(bench.question, misfit=misfit))
    assert ask(bench, found.best, back, done=done).best is not None and len(made) == 2


@pytest.mark.parametrize(
    ("by_seed", "leaving", "explained", "is_taken", "reason"),
    [
        ((114.0, 114.0), (), True, True, "gain 4.0"),
        ((114.0, 104.0), (), True, False, "on a second seed -6.0"),
        ((114.0, 114.0), (("wall_tilt",),), True, False, "leaves something"),
        ((114.0, 114.0), (("wall_tilt",),), False, True, "gain 4.0"),
    ],
)
def test_an_exchange_has_to_stand_as_every_model_that_is_taken(
    by_seed, leaving, explained, is_taken, reason, episode: Episode, monkeypatch
) -> None:
    bench = bench_of(episode)
    answers(monkeypatch, bench, wall_tilt=by_seed)
    leaves(monkeypatch, *leaving)
    both = fit_of(bench, (WALL, TILT), 112.0)
    found = ask(bench, fit_of(bench, (WALL,), 110.0), both, explained=explained)
    assert (found.best is not None) == is_taken
    assert reason in bench.candidates[-1].outcome


@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize("other", [104.0, 101.5, math.nan])
def test_each_effect_may_go_and_what_is_given_stays(
    given: int, other: float, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = replace(bench_of(episode), given=given)
    current, tried = fit_of(bench, (FLOOR, WALL), 100.0), fit_of(bench, (FLOOR, WALL, TILT), 101.0)
    values = {"floor_compliance+wall_tilt": (105.0, 105.0), "wall_friction+wall_tilt": (other,) * 2}
    made = answers(monkeypatch, bench, **values)
    near = Close(fit_of(bench, (FLOOR, BIAS), 99.0), 6.0)
    found = ask(bench, current, tried, (near,))
    assert found.best is not None and found.best.effects == (FLOOR, TILT)
    told = [("wall_friction", "wall_tilt")] if other == 104.0 and not given else []
    assert [one.fit.names for one in found.close] == told  # `near` came close to what has gone
    asked = [("wall_friction", "wall_tilt"), ("floor_compliance", "wall_tilt")]
    assert [names for names, _ in made] == asked[given:]
    # All that is a number is told, and what was taken as such, whatever came first.
    outcomes = [c.outcome for c in bench.candidates if c.name == "wall_tilt"]
    assert [o.split(":")[0] for o in outcomes] == [
        *(["rejected in place of floor_compliance"] if other > 0 and not given else []),
        "accepted in place of wall_friction",
    ]


def test_the_first_effect_may_give_way_and_the_last_stay(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    current, tried = fit_of(bench, (FLOOR, WALL), 100.0), fit_of(bench, (FLOOR, WALL, TILT), 101.0)
    values = {"floor_compliance+wall_tilt": (90.0, 90.0), "wall_friction+wall_tilt": (105.0, 105.0)}
    answers(monkeypatch, bench, **values)
    found = ask(bench, current, tried)
    assert found.best is not None and found.best.effects == (WALL, TILT)
    assert [c.outcome.split(":")[0] for c in bench.candidates] == [
        "rejected in place of wall_friction",
        "accepted in place of floor_compliance",
    ]


def test_an_effect_takes_the_place_of_a_formula_for_less(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A formula counts for two effects: 6 nats more are asked of it."""
    bench = bench_of(episode)
    current, formula = fit_of(bench, (FORMULAS[0],), 110.0), FORMULAS[0].name
    for value, is_taken, close in ((104.5, True, [formula]), (103.5, False, ["wall_tilt"])):
        answers(monkeypatch, bench, wall_tilt=(value, value))
        found = ask(bench, current, fit_of(bench, (FORMULAS[0], TILT), 111.0))
        assert (found.best is not None) == is_taken
        assert [name for one in found.close for name in one.fit.names] == close


def test_what_gains_nothing_or_fails_or_is_a_formula_takes_no_place(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    current = fit_of(bench, (WALL,), 110.0)
    made = answers(monkeypatch, bench)
    near = (Close(fit_of(bench, (FLOOR,), 109.0), 6.0),)
    law = fit_of(bench, (WALL, FORMULAS[0]), 120.0)
    for tried in (None, fit_of(bench, (WALL, TILT), 109.0), law):
        found = ask(bench, current, tried, near)
        assert found.best is None and found.close == near and made == []
    tried = fit_of(bench, (WALL, TILT), 112.0)  # of which `answers` knows nothing
    found = ask(bench, current, tried, near)
    assert found.best is None and found.close == near and len(made) == 1
    assert "wall_tilt in place of wall_friction failed" in bench.notes[0]
    # What came close to a model that is fitted better by now does so no longer.
    assert ask(bench, fit_of(bench, (WALL,), 112.5), None, near).close == ()


def test_a_round_keeps_what_it_tried(episode: Episode, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_of(episode)
    leaves(monkeypatch)
    base = fit_of(bench, (), 100.0)
    for value, is_accepted in ((111.0, True), (105.0, False)):
        tried = replace(fit_of(bench, (WALL,), 0.0), by_seed=(value, value))
        found = naming._judged(bench, base, [tried], 1)
        assert found.tried is tried and (found.best is tried) == is_accepted
        # Beside a better base it may be too little.
        less = bases.held_against(bench, found, fit_of(bench, (), 108.0))
        assert less.tried is tried and less.best is None


def test_the_search_goes_on_beside_what_took_the_place(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    rounds: list[tuple[str, ...]] = []

    def named(bench: Workbench, current: Fit, pool, adequate: bool) -> Round:
        rounds.append(current.names)
        if not current.effects:
            best = fit_of(bench, (WALL,), 110.0)
            return Round(current, best, tried=best)
        beside = TILT if current.effects == (WALL,) else WALL
        more = 5.0 if beside is TILT else -2.0
        tried = fit_of(bench, (*current.effects, beside), current.log_evidence + more)
        return Round(current, tried=tried)

    answers(monkeypatch, bench, wall_tilt=(118.0, 118.0))
    monkeypatch.setattr(search, "fit_well", lambda *_, **__: fit_of(bench, (), 60.0))
    monkeypatch.setattr(search, "name_one", named)
    monkeypatch.setattr(search, "pruned", lambda bench, fit, *_: fit)
    monkeypatch.setattr(search, "needless", lambda *_: [])
    monkeypatch.setattr(search, "outdone", lambda bench, base, current, *_: Round(current))
    monkeypatch.setattr(search, "better_base", lambda bench, current, *_: (current, None))
    monkeypatch.setattr(bases, "strained", lambda _: False)
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    found = search._search(bench, ())
    assert rounds == [(), ("wall_friction",), ("wall_tilt",)]
    assert found.final.effects == (TILT,) and found.close == ()
