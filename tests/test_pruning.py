"""Effects that a model no longer needs go."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from diagnosis_bench import CATALOGUE, bench_of, far_from_the_wall

from tpcd.belief.cloud import start_cloud
from tpcd.data.episode import Episode
from tpcd.discrepancy import pruning, search
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.diagnosis import Candidate
from tpcd.discrepancy.fit import Fit, Question
from tpcd.discrepancy.pruning import needless, pruned
from tpcd.discrepancy.workbench import Close, Round, Workbench
from tpcd.effects import find_effect
from tpcd.effects.protocol import Effect

WALL, TILT = CATALOGUE[1:]
"""Both may go either way from their null value, 0."""
BIAS = find_effect("force_bias")


@pytest.fixture(scope="module")
def episode() -> Episode:
    return far_from_the_wall()


def fit_of(bench: Workbench, effects: tuple[Effect, ...], away: dict[str, float], value=0.0) -> Fit:
    """A made-up fit in which parameters lie so many standard deviations from their null value."""
    prior = bench.question.scene.with_effects(effects)
    generator = torch.Generator().manual_seed(0)
    vector = (prior.low + prior.high)[None].repeat(400, 1) / 2
    for entry, name in enumerate(prior.names[prior.scene_dimension :], prior.scene_dimension):
        draws = torch.randn(400, generator=generator, dtype=torch.float64)
        draws = (draws - draws.mean()) / draws.std(correction=0)
        size = 0.02 * (prior.high - prior.low)[entry]
        vector[:, entry] = size * (away.get(name, 0.0) + draws)  # null values are 0
    score = torch.cat((prior.to_score(vector), torch.zeros(400, 1)), dim=-1)
    return Fit(effects, bench.question.step, prior, (value,), (start_cloud(score),))


def test_what_gained_so_much_has_its_null_value_far_away(episode: Episode) -> None:
    """6 nats are asked for, and sqrt(12) is 3.46; of three parameters together."""
    bench = bench_of(episode)
    wall, tilt = "wall_friction.log_ratio", "wall_tilt.angle"
    assert [p.null for e in (WALL, TILT, BIAS) for p in e.parameters] == 5 * [0.0]
    for away, expected in (
        ({wall: 3.4, tilt: 3.5}, [WALL]),
        ({wall: 3.5, tilt: -3.4}, [TILT]),
        ({wall: -3.5, tilt: 3.5}, []),
    ):
        fit = fit_of(bench, (WALL, TILT), away)
        assert needless(bench, fit) == expected
        # What was given is not asked about.
        assert needless(replace(bench, given=1), fit) == [e for e in expected if e is TILT]
    for size, expected in ((1.9, [BIAS]), (2.1, [])):
        away = {f"force_bias.{p.name}": size for p in BIAS.parameters}
        assert needless(bench, fit_of(bench, (BIAS,), away)) == expected
    # A single draw says nothing else than that it is there.
    fit = fit_of(bench, (WALL,), {})
    cloud = replace(fit.clouds[0], weights=torch.eye(400, dtype=torch.float64)[0])
    assert needless(bench, replace(fit, clouds=(cloud,))) == []


@pytest.mark.parametrize(
    ("away", "gains", "kept", "asked"),
    [
        # The last effect is asked about where it may be nothing, the others always.
        (5.0, {"wall_friction": 50.0, "wall_tilt": 1.0}, (WALL, TILT), ["wall_friction"]),
        (0.0, {"wall_friction": 50.0, "wall_tilt": 1.0}, (WALL,), ["wall_friction", "wall_tilt"]),
        (0.0, {"wall_friction": 50.0, "wall_tilt": 6.5}, (WALL, TILT), None),
        (5.0, {"wall_friction": 5.5, "wall_tilt": 50.0}, (TILT,), ["wall_friction"]),
    ],
)
def test_what_is_no_longer_needed_goes(
    away: float, gains, kept, asked, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    bench.candidates.append(Candidate("wall_tilt", 2, 9.0, (), "accepted: gain 9.0"))
    # The first may be nothing too, and is asked about once all the same.
    fit = fit_of(bench, (WALL, TILT), {"wall_tilt.angle": away}, 60.0)
    without: list[str] = []

    def fitted(question: Question, effects, seeds, *_, **__) -> Fit:
        (gone,) = {e.name for e in (WALL, TILT)} - {e.name for e in effects}
        without.append(gone)
        return Fit(tuple(effects), question.step, question.scene, (60.0 - gains[gone],), ())

    monkeypatch.setattr(pruning, "fit_model", fitted)
    assert pruned(bench, fit).effects == kept
    assert without == (["wall_friction", "wall_tilt"] if asked is None else asked)
    ending = "" if TILT in kept else "; no longer needed"
    assert bench.candidates[0].outcome == "accepted: gain 9.0" + ending


def test_an_effect_that_the_search_for_formulas_shows_to_be_nothing_goes(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model with it is fitted better there, and its size is then none."""
    bench = bench_of(episode)
    rounds: list[tuple[str, ...]] = []
    one = fit_of(bench, (WALL,), {"wall_friction.log_ratio": 9.0}, 100.0)

    def named(bench: Workbench, current: Fit, pool, adequate: bool) -> Round:
        rounds.append(current.names)
        if not current.effects:
            return Round(current, one)
        if current.effects == (WALL,) and current.log_evidence == 100.0:
            return Round(current, fit_of(bench, (WALL, TILT), {"wall_tilt.angle": 9.0}, 110.0))
        return Round(current)

    def found_better(bench: Workbench, base: Fit, current: Fit, explained: bool) -> Round:
        moved = {"wall_friction.log_ratio": 9.0}
        again = fit_of(bench, current.effects, moved, 150.0)
        return Round(again, None, (Close(again, 1.0),) if len(current.effects) > 1 else ())

    def less(question: Question, effects, seeds, *_, **__) -> Fit:
        return replace(one, by_seed=(149.0 if len(rounds) > 2 else 100.0,))

    monkeypatch.setattr(search, "fit_well", lambda *_, **__: fit_of(bench, (), {}))
    monkeypatch.setattr(search, "name_one", named)
    monkeypatch.setattr(search, "outdone", found_better)
    monkeypatch.setattr(search, "better_base", lambda bench, current, *_: (current, None))
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    monkeypatch.setattr(pruning, "fit_model", less)
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: Adequacy(0.01, 0.5, 0.5, ()))
    found = search._search(bench, ())
    assert found.final.effects == (WALL,) and found.final.log_evidence == 150.0
    assert found.close == ()  # it came close to what is no more
    both = ("wall_friction", "wall_tilt")
    assert rounds == [(), ("wall_friction",), both, ("wall_friction",)]


def test_an_effect_that_is_not_needed_as_soon_as_it_is_added_is_not_added_again(
    episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = bench_of(episode)
    pools: list[list[str]] = []
    base = fit_of(bench, (), {}, 100.0)

    def named(bench: Workbench, current: Fit, pool, adequate: bool) -> Round:
        pools.append([effect.name for effect in pool])
        best = fit_of(bench, (WALL,), {}, 110.0) if WALL in pool else None
        return Round(current, best)

    monkeypatch.setattr(search, "fit_well", lambda *_, **__: base)
    monkeypatch.setattr(search, "name_one", named)
    monkeypatch.setattr(search, "better_base", lambda bench, current, *_: (current, None))
    monkeypatch.setattr(search, "find_confusions", lambda *_: None)
    monkeypatch.setattr(search, "step_halving", lambda *_: 0.0)
    better = replace(base, by_seed=(108.0,))
    monkeypatch.setattr(pruning, "fit_model", lambda *_, **__: better)
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: Adequacy(0.01, 0.5, 0.5, ()))
    found = search._search(bench, ())
    assert pools == [[e.name for e in CATALOGUE], [e.name for e in CATALOGUE if e is not WALL]]
    assert found.final is found.base is better and not found.repairs
