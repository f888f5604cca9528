"""Effects that join a belief when it predicts: what is drawn, what is refused, what it mends."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from shutil import copy

import pytest
import torch
from command_calls import call, make_world
from effect_cases import refused_model

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.augmented import found_effects, with_model
from tpcd.belief.belief import Belief
from tpcd.commands.prediction import measured_rows, prediction_error
from tpcd.data.files import read_episode
from tpcd.effects import CATALOGUE
from tpcd.effects.catalogue import find_effect
from tpcd.effects.model import Model, load_model, write_model
from tpcd.predict import ContactPredictor
from tpcd.random import stream
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import Recording, make_motion, record
from tpcd.truth.scene import draw_scene

SOFT = find_effect("floor_compliance", CATALOGUE)
BIAS = find_effect("force_bias", CATALOGUE)
COMPLIANCE = 3e-4
"""Of the floor that hides it [m/N]: 3 mm at 10 N."""


def soft(mean: float, std: float, **step) -> Model:
    """A model of a floor whose compliance was found."""
    return Model((SOFT,), StepSettings(**step), {"floor_compliance": {"compliance": (mean, std)}})


@pytest.fixture(scope="module")
def learnt() -> tuple[Belief, Recording]:
    """A belief that was learnt on a rigid floor, and a test on one that yields."""
    outline = builtin_outlines()["milk_carton"]
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("milk_carton", outline.vertices, generator)
    explored = record(
        make_truth(scene, "quasistatic"),
        scene,
        make_motion("rich", scene, 8, generator),
        8,
        generator,
    )
    hidden = {"floor_compliance": {"compliance": COMPLIANCE}}
    truth = make_truth(scene, "quasistatic", hidden, 12)
    test = record(truth, scene, make_motion("test", scene, 12, generator), 12, generator)
    settings = EstimatorSettings(sampler=SamplerSettings(particles=200), misfit_sd=3e-4)
    sampler = torch.Generator().manual_seed(0)
    *_, last = estimate(explored.measured, PolygonShape(outline), sampler, settings)
    return last.belief, test


def error_of(belief: Belief, test: Recording) -> torch.Tensor:
    """Mean absolute one-step error of each channel."""
    episode = test.measured
    found = ContactPredictor(belief, 100).predict(
        episode.poses[:-1], episode.commands[1:], previous=episode.commands[:-1]
    )
    rows = measured_rows(test.true)[1:]
    return prediction_error(rows, found.mean).abs().mean(0)


def test_a_floor_that_yields_is_predicted_by_a_belief_of_a_rigid_one(learnt) -> None:
    belief, test = learnt
    generator = torch.Generator().manual_seed(0)
    joined = with_model(belief, soft(COMPLIANCE, 1e-5), generator)
    before, after = error_of(belief, test), error_of(joined, test)
    assert float(test.true.wrenches[:, 1].max()) > 3.0  # the floor is leant on
    assert float(before[1]) > 4e-4
    assert float(after[1]) < 0.5 * float(before[1])
    assert float(after[4]) < 0.5 * float(before[4])


def test_draws_are_those_that_were_found(learnt) -> None:
    belief, _ = learnt
    generator = torch.Generator().manual_seed(1)
    names = ("vectors", "misfit_sd", "misfit_mean", "misfit_covariance", "weights")
    many = replace(belief, **{name: getattr(belief, name)[[0] * 20_000] for name in names})
    drawn = with_model(many, soft(2e-4, 2e-5), generator).vectors[:, -1]
    assert float(drawn.mean()) == pytest.approx(2e-4, rel=5e-3)
    assert float(drawn.std()) == pytest.approx(2e-5, rel=0.03)
    # At the end of the prior the normal distribution is cut off: its mean is sd sqrt(2 / pi).
    low = SOFT.parameters[0].low
    drawn = with_model(many, soft(low, 2e-5), generator).vectors[:, -1]
    assert float(drawn.min()) >= low
    assert float(drawn.mean()) == pytest.approx(low + 2e-5 * (2 / torch.pi) ** 0.5, rel=0.03)


@pytest.mark.parametrize("times", [-100.0, 100.0])
def test_what_was_found_far_beyond_an_end_of_the_prior_is_drawn_from_that_end(
    learnt, times: float
) -> None:
    belief, _ = learnt
    (parameter,) = SOFT.parameters
    width, end = parameter.high - parameter.low, parameter.high if times > 0 else parameter.low
    drawn = with_model(belief, soft(end + times * 1e-3 * width, 1e-3 * width), torch.Generator())
    assert float((drawn.vectors[:, -1] - end).abs().max()) < 0.01 * width


@pytest.mark.parametrize("mean", [2e-4, -1.0, 1.0])
def test_values_known_for_certain_are_taken_within_the_prior(learnt, mean: float) -> None:
    belief, _ = learnt
    (parameter,) = SOFT.parameters
    drawn = with_model(belief, soft(mean, 0.0), torch.Generator()).vectors[:, -1]
    expected = min(max(mean, parameter.low), parameter.high)
    assert (drawn == expected).all()


@pytest.mark.parametrize(
    ("mean", "std", "low", "high"),
    [
        (3e-4, 2e-5, 2.2e-4, 3.8e-4),
        (3e-5, 2e-5, 0.0, 1.1e-4),  # the range of the prior holds
        (3e-4, 0.0, 2.992e-4, 3.008e-4),  # known exactly
        (9e-4, 1e-5, 7.6e-4, 8e-4),  # found beyond the range
    ],
)
def test_an_estimate_from_other_data_starts_at_what_was_found(
    mean: float, std: float, low: float, high: float
) -> None:
    (effect,) = soft(mean, std).informed
    (parameter,) = effect.parameters
    assert (parameter.low, parameter.high) == pytest.approx((low, high))
    assert Model((SOFT, BIAS)).informed == (SOFT, BIAS)


def test_an_estimate_with_effects_draws_more(world: Path) -> None:
    episode = read_episode(world / "explore.csv")
    few = SamplerSettings(particles=16, places=4, fresh_modes=4, modes=2, draws=200)
    for effects, times in (((), 1), ((SOFT,), 3)):
        settings = EstimatorSettings(sampler=few, effects=effects)
        first = next(estimate(episode, load_prior("ycb21-z2"), stream(3), settings))
        assert first.info.draws == 200 * times


def test_without_anything_found_draws_are_of_the_prior(learnt) -> None:
    belief, _ = learnt
    joined = with_model(belief, Model((BIAS,)), torch.Generator().manual_seed(2))
    place = (joined.vectors - joined.prior.low) / (joined.prior.high - joined.prior.low)
    drawn = place[:, belief.prior.dimension :]
    assert joined.prior.names[-3:] == ("force_bias.F_x", "force_bias.F_z", "force_bias.tau")
    assert float(drawn.min()) >= 0 and float(drawn.max()) <= 1
    assert (drawn.mean(0) - 0.5).abs().max() < 0.15
    assert torch.equal(joined.vectors[:, : belief.prior.dimension], belief.vectors)


def test_the_step_is_that_of_the_belief_unless_the_model_has_its_own(learnt) -> None:
    belief, _ = learnt
    generator = torch.Generator()
    assert with_model(belief, soft(2e-4, 0.0), generator).step == belief.step
    assert with_model(belief, soft(2e-4, 0.0, substeps=7), generator).step.substeps == 7


def test_what_a_belief_says_of_its_effects_comes_back_from_a_model_file(
    learnt, tmp_path: Path
) -> None:
    belief, _ = learnt
    joined = with_model(belief, soft(2e-4, 2e-5), torch.Generator().manual_seed(4))
    found = found_effects(joined)
    assert found_effects(belief) == {}
    mean, std = found["floor_compliance"]["compliance"]
    assert (mean, std) == (float(joined.mean()[-1]), float(joined.std()[-1]))
    model = Model((SOFT,), found=found)
    assert load_model(write_model(model, tmp_path / "model.yaml")) == model
    with pytest.raises(ValueError, match="'floor_compliance' already"):
        with_model(joined, model, torch.Generator())


FOUND = {
    "other name": ("{slope: [1, 1]}", "expected compliance"),
    "one number": ("{compliance: [1]}", "expected [mean, sd >= 0]"),
    "negative": ("{compliance: [1, -1]}", "expected [mean, sd >= 0]"),
    "not a number": ("{compliance: [.nan, 1]}", "expected [mean, sd >= 0]"),
    "no mapping": ("3", "expected compliance"),
}


@pytest.mark.parametrize("case", FOUND)
def test_what_was_found_is_refused_where_it_makes_no_sense(tmp_path: Path, case: str) -> None:
    text, told = FOUND[case]
    found = f"effects: [{{name: floor_compliance, found: {text}}}]"
    assert told in refused_model(tmp_path, found)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_world(tmp_path_factory.mktemp("world"))


def test_predict_takes_a_model(world: Path, tmp_path: Path, capsys) -> None:
    path = write_model(soft(2e-4, 1e-5), tmp_path / "model.yaml")
    given = (str(world / "run"), str(world / "explore.csv"), "--out")
    plain, soft_out = tmp_path / "plain.csv", tmp_path / "soft.csv"
    assert call("predict", *given, str(plain)) == 0
    capsys.readouterr()
    assert call("predict", *given, str(soft_out), "--model", str(path)) == 0
    assert f"floor_compliance is drawn from what was found in {path}" in capsys.readouterr().out
    tables = [list(csv.DictReader(out.open())) for out in (plain, soft_out)]
    heights = [[float(row["z_mean"]) for row in table] for table in tables]
    # The floor yields, and what leans on it comes to rest lower.
    assert min(b - a for a, b in zip(*heights, strict=True)) < -1e-4


def test_estimate_takes_what_was_found_and_predict_then_needs_no_model(
    world: Path, tmp_path: Path, capsys
) -> None:
    """The floor of these data is rigid: a prior of all compliances would be near 0."""
    path = write_model(soft(2e-4, 1e-5), tmp_path / "model.yaml")
    rows = (world / "explore.csv").read_text().splitlines()[:4]
    (tmp_path / "start.csv").write_text("\n".join(rows) + "\n")
    copy(world / "explore.yaml", tmp_path / "start.yaml")
    episode, out = str(tmp_path / "start.csv"), tmp_path / "run"
    arguments = ("--prior", "ycb21-z2", "--particles", "32", "--out", str(out))
    assert call("estimate", episode, *arguments, "--model", str(path)) == 0
    (kept,) = load_model(out / "model.yaml").effects
    assert (kept.parameters[0].low, kept.parameters[0].high) == pytest.approx((1.6e-4, 2.4e-4))
    parameters = json.loads((out / "summary.json").read_text())["parameters"]
    assert 1.6e-4 < parameters["floor_compliance.compliance"]["mean"] < 2.4e-4
    capsys.readouterr()
    given = (str(out), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    assert call("predict", *given, "--model", str(path)) != 0
    told = capsys.readouterr().err
    assert "'floor_compliance' already" in told and f"leave {path} out" in told
    assert not (tmp_path / "p.csv").exists()
