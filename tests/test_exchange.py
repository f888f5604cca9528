"""What is tried in vain beside an effect may take its place."""

from __future__ import annotations

from dataclasses import replace

import pytest
from diagnosis_bench import CATALOGUE, bench_of, far_from_the_wall

from tpcd.data.episode import Episode
from tpcd.discrepancy import exchange, search
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.exchange import Asked, exchanged
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.workbench import Close, Round, Workbench
from tpcd.effects.formula import FORMULAS
from tpcd.effects.protocol import Effect

FLOOR, WALL, TILT = CATALOGUE


@pytest.fixture(scope="module")
def episode() -> Episode:
    return far_from_the_wall()


def fit_of(bench: Workbench, effects: tuple[Effect, ...], value: float) -> Fit:
    """A made-up fit."""
    return Fit(effects, bench.question.step, bench.question.scene, (value,), ())


def answers(monkeypatch: pytest.MonkeyPatch, bench: Workbench, **values: float) -> list[tuple]:
    """Fits have the log evidence of their last effect; what was asked for, and from where."""
    made: list[tuple] = []

    def fitted(question: Question, effects, seeds, start=()) -> Fit:
        made.append((tuple(e.name for e in effects), tuple(one.names for one in start)))
        return fit_of(bench, tuple(effects), values["+".join(e.name for e in effects)])

    monkeypatch.setattr(exchange, "fit_model", fitted)
    return made


@pytest.mark.parametrize(
    ("value", "is_taken", "close"),
    [
        (114.0, True, []),  # 4 better: what was there is not even close
        (111.0, True, ["wall_friction"]),
        (109.0, False, ["wall_tilt"]),
        (106.0, False, []),
    ],
)
def test_what_explains_the_data_better_takes_the_place(
    value: float, is_taken: bool, close, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    bench.candidates += [
        Candidate("wall_friction", 1, 50.0, (110.0,), "accepted: gain 50.0"),
        Candidate("wall_tilt", 1, 30.0, (90.0,)),
        Candidate("wall_tilt", 2, 2.0, (112.0,), "rejected: gain 2.0"),
    ]
    current, tried = fit_of(bench, (WALL,), 110.0), fit_of(bench, (WALL, TILT), 112.0)
    made, asked = answers(monkeypatch, bench, wall_tilt=value), Asked()
    found = exchanged(bench, Round(current, tried=tried), (), asked)
    assert made == [(("wall_tilt",), (("wall_friction", "wall_tilt"), ("wall_friction",)))]
    assert found.base is current and (found.best is not None) == is_taken
    assert [one.fit.names[-1] for one in found.close] == close
    # Gains are over the model without effects, whose log evidence is 60.
    own = {c.name: c for c in bench.candidates if c.round == 1}
    assert own["wall_tilt"].gain == value - 60.0
    assert all(one.gain == one.fit.log_evidence - 60.0 for one in found.close)
    assert own["wall_tilt"].outcome.startswith("accepted" if is_taken else "rejected")
    assert own["wall_friction"].outcome.endswith("gave way to wall_tilt") == is_taken
    # What was asked beside an effect that goes is asked anew.
    assert any(c.round == 2 for c in bench.candidates) == (not is_taken)
    # Back, and the same once more, are not asked about.
    back = replace(found, base=found.best or current, tried=tried)
    assert exchanged(bench, back, found.close, asked).best is None and len(made) == 1


def test_each_effect_may_go_and_what_is_given_stays(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = replace(bench_of(episode), given=1)
    current, tried = fit_of(bench, (FLOOR, WALL), 100.0), fit_of(bench, (FLOOR, WALL, TILT), 101.0)
    values = {"floor_compliance+wall_tilt": 105.0}
    made = answers(monkeypatch, bench, **values)
    near = Close(fit_of(bench, (FLOOR, FORMULAS[0]), 99.0), 6.0)
    found = exchanged(bench, Round(current, tried=tried), (near,), set())
    assert found.best is not None and found.best.effects == (FLOOR, TILT) and len(made) == 1
    assert found.close == ()  # it came close to what has given way
    made = answers(
        monkeypatch, replace(bench, given=0), **values, **{"wall_friction+wall_tilt": 9.0}
    )
    bench = replace(bench, given=0)
    found = exchanged(bench, Round(current, tried=tried), (near,), set())
    assert found.best is not None and found.best.effects == (FLOOR, TILT)
    assert [names for names, _ in made] == [
        ("wall_friction", "wall_tilt"),
        ("floor_compliance", "wall_tilt"),
    ]


def test_what_gains_nothing_or_fails_or_is_a_formula_takes_no_place(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    current = fit_of(bench, (WALL,), 110.0)
    made = answers(monkeypatch, bench)
    near = (Close(fit_of(bench, (FLOOR,), 109.0), 6.0),)
    for tried in (
        None,
        fit_of(bench, (WALL, TILT), 109.0),
        fit_of(bench, (WALL, FORMULAS[0]), 120.0),
    ):
        found = exchanged(bench, Round(current, tried=tried), near, set())
        assert found.best is None and found.close == near and made == []
    tried = fit_of(bench, (WALL, TILT), 112.0)  # which `answers` knows no value for
    found = exchanged(bench, Round(current, tried=tried), near, set())
    assert found.best is None and found.close == near and len(made) == 1
    assert "wall_tilt in place of wall_friction failed" in bench.notes[0]


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

    answers(monkeypatch, bench, wall_tilt=118.0)
    monkeypatch.setattr(search, "fit_well", lambda *_, **__: fit_of(bench, (), 60.0))
    monkeypatch.setattr(search, "name_one", named)
    monkeypatch.setattr(search, "pruned", lambda bench, fit, *_: fit)
    monkeypatch.setattr(search, "needless", lambda *_: [])
    monkeypatch.setattr(search, "outdone", lambda bench, base, current, *_: Round(current))
    monkeypatch.setattr(search, "better_base", lambda bench, current, *_: (current, None))
    monkeypatch.setattr(search, "strained", lambda _: False)
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: Adequacy(0.01, 0.5, 0.5, ()))
    found = search._search(bench, ())
    assert rounds == [(), ("wall_friction",), ("wall_tilt",)]
    assert found.final.effects == (TILT,) and found.close == ()
