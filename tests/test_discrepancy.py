"""The gap workflow on a known outline, and its parts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tpcd.belief.history import history_of, joined_history
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy
from tpcd.discrepancy.conclude import Findings, conclude
from tpcd.discrepancy.coverage import contact_rows, coverage_of
from tpcd.discrepancy.diagnosis import Cell
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import FIT_SAMPLER, Fit, Question
from tpcd.discrepancy.gaps import Errors, Gaps
from tpcd.discrepancy.heldout import folds
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.preflight import free_space_score, parity_score
from tpcd.discrepancy.report_parts import shown_value
from tpcd.discrepancy.search import DiagnosisSettings, diagnose
from tpcd.discrepancy.workbench import Workbench
from tpcd.effects import find_effect
from tpcd.effects.check import check_effect
from tpcd.effects.conditions import Conditions, Outcome, Rows
from tpcd.effects.declare import DeclaredEffect
from tpcd.effects.excitations import MOTIONS, NEEDED
from tpcd.effects.protocol import EffectParameter
from tpcd.errors import RunError
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import QuasistaticTruth, StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

SMALL = DiagnosisSettings(
    sampler=replace(
        FIT_SAMPLER,
        particles=150,
        draws_per_place=9,
        draws=600,
        prior_draws=200,
        fresh_modes=40,
        modes=8,
        rounds=2,
        places=40,
    ),
    catalogue=tuple(find_effect(n) for n in ("floor_compliance", "floor_tilt", "command_lag")),
    full_fits=2,
)


def recorded(hidden: dict[str, dict[str, float]], steps: int = 30, seed: int = 5) -> Episode:
    generator = torch.Generator().manual_seed(seed)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    truth = make_truth(scene, "quasistatic", hidden, steps)
    motion = make_motion("diagnosis", scene, steps, generator)
    return record(truth, scene, motion, steps, generator).measured


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["mug"])


@pytest.fixture(scope="module")
def clean() -> Episode:
    return recorded({})


def test_clean_data_miss_nothing(shape: PolygonShape, clean: Episode) -> None:
    told: list[str] = []
    found = diagnose([clean], shape, SMALL, tell=told.append)
    assert found.verdict == "nothing_missing" and found.names == ()
    assert {limit.name for limit in found.detection_limits} == {e.name for e in SMALL.catalogue}
    assert told[-1].startswith("verdict: nothing missing")


def test_a_soft_floor_is_named_with_its_size_and_the_gap_shrinks(shape: PolygonShape) -> None:
    size = 3e-4
    hidden = {"floor_compliance": {"compliance": size}}
    fresh = recorded(hidden, seed=5)
    found = diagnose([recorded(hidden)], shape, SMALL, fresh=[fresh])
    assert found.verdict == "named" and found.names == ("floor_compliance",)
    (parameter,) = found.effects[0].parameters
    assert abs(parameter.value - size) < 3 * parameter.sd + 0.1 * size
    assert "mm per 10 N" in found.sentence
    by_channel = {gap.channel: gap for gap in found.gap}
    assert by_channel["z"].after < by_channel["z"].before
    assert found.share_closed > 0.7
    assert 0.5 < found.share_closed_low <= found.share_closed <= found.share_closed_high
    on_floor, free = (
        next(g for g in found.gap_by_contact if (g.contact, g.channel) == (contact, "z"))
        for contact in ("floor", "free")
    )
    assert on_floor.before > 2 * on_floor.noise_floor > 2 * on_floor.after / 1.5
    assert free.before < 1.5 * free.noise_floor
    assert found.log_evidence - found.log_evidence_base > SMALL.least_gain
    assert (
        found.belief is not None and found.belief.prior.names[-1] == "floor_compliance.compliance"
    )


@pytest.mark.slow
def test_a_sensor_that_is_off_by_the_square_of_the_force_is_not_nothing(
    shape: PolygonShape, clean: Episode
) -> None:
    """No effect that is asked for is of the sensor, and none of the pose is to be named."""
    wrenches = clean.wrenches.clone()
    wrenches[:, :2] *= 1 + wrenches[:, :2].abs() / 40
    found = diagnose([replace(clean, wrenches=wrenches)], shape, SMALL)
    assert found.verdict == "unknown_remains" and found.names == ()
    assert "F_x" in found.sentence or "F_z" in found.sentence
    assert found.cells_after[0].channel in ("F_x", "F_z")


def test_an_object_larger_than_any_of_the_prior_is_no_effect(shape: PolygonShape) -> None:
    generator = torch.Generator().manual_seed(6)
    outline = builtin_outlines()["mug"].vertices
    scene = draw_scene("mug", 2.2 * outline, generator)
    motion = make_motion("diagnosis", scene, 30, generator)
    truth = make_truth(scene, "quasistatic", {}, 30)
    episode = record(truth, scene, motion, 30, generator).measured
    told: list[str] = []
    found = diagnose([episode], shape, SMALL, tell=told.append)
    assert found.verdict == "nothing_missing", found.sentence
    assert "unlike those of the shape prior" in found.shape
    scale = next(e for e in found.theta_after if e.name == "scale")
    assert abs(scale.value - 2.2 * scene.theta["scale"]) < 0.1
    extents = scene.vertices_ee.amax(0) - scene.vertices_ee.amin(0)
    for name, true in zip(("object_width", "object_height"), extents.tolist(), strict=True):
        size = next(e for e in found.theta_after if e.name == name)
        assert abs(size.value - true) < 2 * size.sd and size.sd < 0.004
    # Which of two places the model without the scale ends in is a matter of seeds: 5 to 30 % are
    # unexplained there. Its evidence is the same.
    assert found.log_evidence > found.log_evidence_base + 50
    assert found.unexplained_before > 0.03 > found.unexplained_after


def test_a_simulator_that_lifts_what_slides_is_called_numerics(shape: PolygonShape) -> None:
    generator = torch.Generator().manual_seed(7)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    scene = replace(scene, friction=0.6)
    truth = QuasistaticTruth(
        *(scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position),
        *(scene.stiffness, StepSettings(friction="anitescu", substeps=1)),
    )
    truth.reset(scene.start_pose)
    motion = make_motion("diagnosis", scene, 30, generator)
    episode = record(truth, scene, motion, 30, generator).measured
    found = diagnose([episode], shape, replace(SMALL, catalogue=()))
    assert found.names == ("numerics",) and found.verdict == "named"
    assert found.belief is not None and found.belief.step.friction == "anitescu"
    # Before is the model that was given.
    assert found.belief_before is not None and found.belief_before.step.friction == "coulomb"
    assert found.log_evidence > found.log_evidence_base + SMALL.least_gain
    assert found.share_closed > 0.5
    (tried,) = (c for c in found.candidates if c.name == "relaxed_friction")
    assert tried.outcome == "accepted" and len(tried.by_seed) >= 2


def spoilt(conditions: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None):
    """As the check at the door has few rows, this passes it and fails on an episode."""
    if len(rows.share) > 20:
        raise RuntimeError("more rows than foreseen")
    return replace(conditions, friction=conditions.friction * (1 + values[:, :1, None]))


def test_an_effect_that_fails_costs_no_other(shape: PolygonShape) -> None:
    parameter = EffectParameter("p", "1", 0.0, 1.0)
    broken = DeclaredEffect("broken", "contact tangent", (parameter,), spoilt, "it is {0}")
    check_effect(broken)
    settings = replace(SMALL, catalogue=(broken, find_effect("floor_compliance")))
    found = diagnose([recorded({"floor_compliance": {"compliance": 3e-4}})], shape, settings)
    assert found.names == ("floor_compliance",) and found.verdict == "named"
    failed = [note for note in found.notes if "more rows than foreseen" in note]
    assert failed and all("broken" in note for note in failed)


def test_a_diagnosis_that_was_stopped_goes_on_with_the_fits_it_had(
    shape: PolygonShape, clean: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[str] = []
    whole = diagnose([clean], shape, SMALL, memory=Memory(tmp_path, watch=begun.append))
    assert {"fit of the base model", "what the base model leaves"} < set(begun)
    assert {f"look at {effect.name}" for effect in SMALL.catalogue} < set(begun)
    kept = sorted(tmp_path.iterdir())
    assert len(kept) > 4
    for path in kept[::2]:  # as if it had been stopped before these
        path.unlink()
    half = diagnose([clean], shape, SMALL, memory=Memory(tmp_path))
    assert half.log_evidence == whole.log_evidence and half.candidates == whole.candidates
    assert sorted(tmp_path.iterdir()) == kept

    def never(*arguments: object) -> None:
        raise AssertionError("a fit was made again")

    monkeypatch.setattr("tpcd.discrepancy.evidence._fitted", never)
    monkeypatch.setattr("tpcd.discrepancy.screening._climbed", never)
    monkeypatch.setattr("tpcd.discrepancy.nested._weighed", never)
    again = diagnose([clean], shape, SMALL, memory=Memory(tmp_path))
    assert again.log_evidence == whole.log_evidence and again.candidates == whole.candidates
    assert again.theta_after == whole.theta_after
    # Other data are another question.
    with pytest.raises(AssertionError, match="made again"):
        diagnose([clean.first(25)], shape, SMALL, memory=Memory(tmp_path))
    for path in kept:
        path.write_bytes(b"half")
    with pytest.raises(RunError, match="cannot be read"):
        diagnose([clean], shape, SMALL, memory=Memory(tmp_path))


@pytest.mark.parametrize("share, named", [(0.2, False), (math.nan, False), (0.8, True)])
def test_where_something_is_left_effects_must_close_half_of_the_gap(
    share: float, named: bool, shape: PolygonShape, clean: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(SMALL, sampler=replace(SMALL.sampler, draws=200, fresh_modes=8))
    question = Question(
        joined_history([clean]), make_prior(shape), MisfitField(1e-4), StepSettings(),
        settings.sampler,
    )  # fmt: skip
    bench = Workbench(question, settings, coverage_of([clean]), 0, lambda line: None)
    base = fit_model(question, (), (0,))
    final = fit_model(question, (find_effect("floor_tilt"),), (0,), start=(base,))
    cell = Cell("all", "z", "mean", 2.0, 30)
    left = Adequacy(0.3, 1e-9, 0.5, (cell,))
    episodes, fresh = [clean], [clean.first(6)]
    shares = {id(episodes): share, id(fresh): 1.0 - share}
    asked: list[tuple[Errors, Fit, object]] = []

    def errors(question: Question, fit: Fit, given: object) -> Errors:
        one = Errors(torch.zeros(1, 6).double(), torch.ones(1, 6).double(), torch.zeros(1).long())
        asked.append((one, fit, given))
        return asked[-1][0]

    for name in ("held_out_errors", "prediction_errors"):
        monkeypatch.setattr(f"tpcd.discrepancy.conclude.{name}", errors)

    def closed(before: Errors, after: Errors) -> float:
        (_, first, given), (_, second, same) = (
            next(one for one in asked if one[0] is found) for found in (before, after)
        )
        assert first is base and second is final and given is same
        return shares[id(given)]

    monkeypatch.setattr("tpcd.discrepancy.conclude.typical_share", closed)
    monkeypatch.setattr(
        "tpcd.discrepancy.conclude.gaps", lambda *e: Gaps((), (), closed(*e[:2]), 0.0, 1.0, 0.5)
    )
    monkeypatch.setattr(Workbench, "adequacy", lambda bench, fit: left)
    # What is closed on fresh episodes, here the rest, is shown and names nothing.
    found = conclude(bench, Findings(base, question, base, final, left, left), episodes, fresh)
    assert found.share_closed == 1.0 - share if named else math.isnan(found.share_closed)
    assert found.verdict == "unknown_remains"
    assert found.names == (("floor_tilt",) if named else ())
    assert found.belief is not None and found.belief.prior.effects == final.effects[: int(named)]
    assert any("not named" in note for note in found.notes) != named


def test_a_short_episode_is_not_enough(shape: PolygonShape, clean: Episode) -> None:
    found = diagnose([clean.first(6)], shape, SMALL)
    assert found.verdict == "not_enough_information"
    assert "5 transitions" in found.sentence
    assert {limit.name for limit in found.detection_limits} == {e.name for e in SMALL.catalogue}


def test_set_ups_are_not_mixed(shape: PolygonShape, clean: Episode) -> None:
    other = replace(clean, stiffness=2 * clean.stiffness)
    with pytest.raises(ValueError, match="episode 2 has stiffness"):
        diagnose([clean, other], shape, SMALL)


def test_joined_episodes_say_what_each_says_alone(shape: PolygonShape, clean: Episode) -> None:
    other = recorded({}, steps=8, seed=5)
    prior = make_prior(shape)
    draws = prior.to_parameters(prior.sample(6, torch.Generator().manual_seed(1)))
    sd, field = torch.zeros(6, dtype=torch.float64), MisfitField(0.0)

    def total(*episodes: Episode) -> Tensor:
        history = joined_history(episodes)
        return history_likelihood(shape, draws, sd, history, field, StepSettings()).total

    torch.testing.assert_close(total(clean, other), total(clean) + total(other))


def test_transitions_out_of_use_do_not_count(shape: PolygonShape, clean: Episode) -> None:
    history = history_of(clean)
    prior = make_prior(shape)
    draws = prior.to_parameters(prior.sample(6, torch.Generator().manual_seed(1)))
    sd, field = torch.zeros(6, dtype=torch.float64), MisfitField(0.0)
    used = torch.ones(len(history), dtype=torch.bool)
    used[10:] = False
    settings = StepSettings()
    found = history_likelihood(shape, draws, sd, history.using(used), field, settings).total
    expected = history_likelihood(shape, draws, sd, history.first(10), field, settings).total
    torch.testing.assert_close(found, expected)


def test_coverage_of_the_diagnosis_motion_and_of_a_poor_one(clean: Episode) -> None:
    rich = coverage_of([recorded({}, steps=60)])
    assert set(rich.counts) == set(NEEDED) == set(MOTIONS)
    assert rich.missing(("floor loads", "wall loads", "floor slip both ways", "lift-off")) == []
    free = replace(clean, poses=clean.commands.clone())
    poor = coverage_of([free])
    assert poor.missing(("floor load", "wall slip")) == ["floor load", "wall slip"]


@pytest.mark.parametrize(
    ("hidden", "parity", "free"),
    [
        ({}, False, False),
        ({"floor_tilt": {"angle": 0.03}}, False, False),
        ({"payload": {"weight": 1.0, "lever": 0.0}}, False, True),
        ({"force_bias": {"F_x": 0.6, "F_z": -0.9, "tau": 0.0}}, True, False),
        ({"command_lag": {"share": 0.1}}, True, True),
    ],
)
def test_two_tests_without_theta_split_the_catalogue(
    hidden: dict[str, dict[str, float]], parity: bool, free: bool
) -> None:
    episode = recorded(hidden, steps=60)
    assert (parity_score(history_of(episode))[1] < 1e-3) == parity
    found = free_space_score([episode])
    assert found is not None and (found[1] < 1e-3) == free


def test_rows_too_few_to_be_sure_of_say_nothing_of_free_space(clean: Episode) -> None:
    assert free_space_score([clean.first(4)]) is None


@pytest.mark.parametrize("friction", [0.3, 0.85])
def test_contact_is_read_from_the_impedance_alone(friction: float) -> None:
    generator = torch.Generator().manual_seed(8)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    scene = replace(scene, friction=friction)
    motion = make_motion("diagnosis", scene, 60, generator)
    rows = record(make_truth(scene, "quasistatic"), scene, motion, 60, generator)
    gaps = torch.tensor([scene.clearances(pose) for pose in rows.true.poses])
    for found, true in zip(contact_rows(rows.measured), (gaps < 1e-4).T, strict=True):
        # Friction of the wall pushes up without being the floor; light touches are not seen.
        assert int((found & ~true).sum()) <= 1
        assert int((found & true).sum()) > 0.7 * int(true.sum())
    assert not coverage_of([rows.measured]).missing(("wall slip", "floor slip"))


def test_every_transition_is_held_out_once(clean: Episode) -> None:
    history = history_of(clean)
    masks = torch.stack(folds(history))
    assert (masks.sum(0) == 1).all()


def test_values_are_shown_in_units_for_people() -> None:
    parameter = EffectParameter("c", "m/N", 0.0, 1.0, shown_unit="mm per 10 N", shown_factor=1e4)
    assert shown_value(2.46e-4, 1.3e-5, parameter) == "2.46 ± 0.13 mm per 10 N"
    assert shown_value(0.3, 0.02, EffectParameter("r", "1", 0.0, 1.0)) == "0.300 ± 0.020"
