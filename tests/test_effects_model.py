"""Effects of one's own, from the docs to estimates, predictions and commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call
from effect_cases import SHAPE, block, draws_of, likelihood, make_episode

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.belief import Belief, prior_belief
from tpcd.belief.history import history_of
from tpcd.belief.misfit import MisfitField
from tpcd.belief.storage import load_belief, save_belief
from tpcd.data.episode import Episode
from tpcd.data.files import write_episode
from tpcd.effects import CATALOGUE, KNOWN, Effect
from tpcd.effects.check import check_effect
from tpcd.effects.model import Model, load_model, write_model
from tpcd.effects.own import load_effects
from tpcd.effects.protocol import Added
from tpcd.effects.truth import EffectTruth, added_effects
from tpcd.errors import ModelError
from tpcd.exploration import Estimator
from tpcd.files import to_plain
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings

STIFFNESS = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
BOX = torch.tensor([[-0.05, 0.0], [0.05, 0.0], [0.05, 0.1], [-0.05, 0.1]]).double()
FEW = SamplerSettings(particles=32, draws=200, prior_draws=100, places=10, fresh_modes=8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a user who follows the docs has: the file of effects and the model."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_effects.py").write_text(block("python"))
    (folder / "model.yaml").write_text(block("yaml"))
    return folder


@pytest.fixture(scope="module")
def wet(folder: Path) -> Effect:
    return load_model(folder / "model.yaml").effects[0]


@pytest.fixture(scope="module")
def episode() -> Episode:
    return make_episode()


def test_the_example_of_the_docs_is_a_model(folder: Path) -> None:
    model = load_model(folder / "model.yaml")
    assert [effect.name for effect in model.effects] == ["wet_floor", "floor_compliance"]
    assert [(p.low, p.high) for p in model.effects[0].parameters] == [(-1.5, 1.5), (0.0, 0.1)]
    assert model.step == StepSettings(substeps=6)
    assert "beyond 50 mm" in model.effects[0].sentence(["-0.7", "50 mm"])


def test_the_example_changes_no_bit_at_its_null_values(wet: Effect, episode: Episode) -> None:
    null = torch.tensor([[p.null for p in wet.parameters]], dtype=torch.float64)
    draws, history = draws_of(6), history_of(episode)
    found = likelihood(history, draws, Added((wet,), null.expand(6, -1)))
    assert torch.equal(found, likelihood(history, draws, None))


def test_the_example_does_what_it_says(wet: Effect) -> None:
    hidden = added_effects({"wet_floor": {"log_ratio": -0.7, "edge": 0.15}}, (wet,))
    truth = EffectTruth(BOX, 0.5, 0.0, 0.4, STIFFNESS, hidden, 4)
    truth.reset(torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64))
    ratios = []
    # Turned by a little, the box slides on its right lower corner.
    for x in (0.0, 0.05, 0.2, 0.3):
        pose, wrench, _ = truth.step(torch.tensor([x, -0.03, -0.05], dtype=torch.float64))
        ratios.append(float(-wrench[0] / wrench[1]))
    assert ratios[1] == pytest.approx(0.5, rel=1e-3)
    assert ratios[3] == pytest.approx(0.5 * torch.tensor(-0.7).exp().item(), rel=1e-3)


@pytest.mark.parametrize("effect", KNOWN, ids=lambda effect: effect.name)
def test_the_catalogue_keeps_its_promises(effect: Effect) -> None:
    check_effect(effect)


@pytest.mark.parametrize("effect", KNOWN, ids=lambda effect: effect.name)
def test_every_effect_comes_back_from_a_model_file(effect: Effect, tmp_path: Path) -> None:
    again = load_model(write_model(Model((effect,)), tmp_path / "model.yaml"))
    assert [one.name for one in again.effects] == [effect.name]
    assert again.effects[0].parameters == effect.parameters
    assert again.effects[0].sentence(["1"] * 3) == effect.sentence(["1"] * 3)


def test_an_estimate_takes_the_example(folder: Path, episode: Episode, tmp_path: Path) -> None:
    model = load_model(folder / "model.yaml")
    settings = EstimatorSettings(sampler=FEW, step=model.step, effects=model.effects)
    names = ("wet_floor.log_ratio", "wet_floor.edge", "floor_compliance.compliance")
    before = prior_belief(episode, SHAPE, torch.Generator().manual_seed(0), settings)
    assert before.prior.names[-3:] == names
    for step in estimate(episode.first(3), SHAPE, torch.Generator().manual_seed(0), settings):
        belief = step.belief
    assert belief.prior.names[-3:] == names and belief.prior.units[-3:] == ("1", "m", "m/N")
    assert belief.step == model.step
    save_belief(belief, tmp_path, PRIOR)
    again = load_belief(tmp_path, SHAPE)
    assert torch.equal(again.vectors, belief.vectors) and again.prior.names == belief.prior.names
    for one, other in zip(again.prior.effects, belief.prior.effects, strict=True):
        assert one.parameters == other.parameters
    arguments = (episode.poses[:-1], episode.commands[1:], episode.commands[:-1])
    means = [ContactPredictor(one, 8).predict(*arguments).mean for one in (belief, again)]
    torch.testing.assert_close(*means, rtol=0, atol=0)


def test_a_belief_whose_effects_changed_is_refused(
    folder: Path, episode: Episode, tmp_path: Path
) -> None:
    own = tmp_path / "my_effects.py"
    own.write_text(block("python"))
    settings = EstimatorSettings(sampler=FEW, effects=load_effects(own))
    belief = prior_belief(episode, SHAPE, torch.Generator().manual_seed(0), settings)
    save_belief(belief, tmp_path, PRIOR)
    own.write_text(block("python").replace("0.005", "0.01"))
    with pytest.raises(ModelError, match="my_effects.py: has changed since"):
        load_belief(tmp_path, SHAPE)


def test_settings_with_effects_are_plain_and_readable(wet: Effect) -> None:
    plain = to_plain(EstimatorSettings(effects=(wet, CATALOGUE[0])))
    assert plain["effects"][1] == {
        "name": "floor_compliance",
        "parameters": {"compliance": [0.0, 8e-4]},
    }
    json.dumps(plain)


def belief_with(effects: dict[str, dict[str, float]], episode: Episode) -> Belief:
    """A belief that is sure of a box in a known scene, with known effects."""
    shape = PolygonShape(builtin_outlines()["milk_carton"])
    added = added_effects(effects)
    settings = EstimatorSettings(sampler=FEW, misfit_sd=0.0, effects=added.effects)
    belief = prior_belief(episode, shape, torch.Generator().manual_seed(0), settings)
    theta = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.15], dtype=torch.float64)
    vector = torch.cat((theta, added.values[0]))[None]
    size = belief.misfit_mean.shape[1]
    return (
        replace(
            belief,
            vectors=vector,
            weights=torch.ones(1, dtype=torch.float64),
            misfit=MisfitField(0.0),
            misfit_sd=torch.zeros(1, dtype=torch.float64),
            misfit_mean=torch.zeros(1, 0, dtype=torch.float64),
            misfit_covariance=torch.zeros(1, 0, 0, dtype=torch.float64),
        )
        if size
        else belief
    )


ROLLED = {
    "lag": {"command_lag": {"share": 0.2}},
    "arm friction": {"arm_friction": {"force": 0.5}},
    "drift": {"floor_drift": {"drift": 0.004}, "force_drift": {"F_x": 1.0, "F_z": -1.0}},
    "adhesion": {"adhesion": {"force": 1.0}},
    "soft": {"floor_compliance": {"compliance": 2e-4}},
    "sideways": {"tangential_compliance": {"compliance": 2e-4}},
    "direction": {"directional_friction": {"log_ratio": 0.3}, "payload": {"weight": 1.0}},
}


@pytest.mark.parametrize("case", ROLLED)
def test_rollouts_follow_a_run_with_effects(
    case: str, episode: Episode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The truth of one outline, row after row from the same start."""
    passes = added_effects(ROLLED[case]).passes
    monkeypatch.setattr("tpcd.effects.truth.TRUE_PASSES", passes)
    belief = belief_with(ROLLED[case], episode)
    outline = belief.prior.shape.boundary_points(belief.parameters.latent)[0]
    bottom = float(outline[:, 1].min())
    start = torch.tensor([0.0, 0.02 - bottom, 0.0], dtype=torch.float64)
    down = -bottom - 0.03
    commands = torch.tensor(
        [
            [0.0, down, 0.0], [0.05, down, 0.0], [0.02, down, 0.05], [0.022, down, 0.05],
            [0.022, 0.005 - bottom, 0.0], [0.03, 0.04 - bottom, 0.1], [0.0, down, 0.0],
        ],
        dtype=torch.float64,
    )  # fmt: skip
    truth = EffectTruth(
        outline.double(), 0.4, 0.0, 0.15, STIFFNESS, added_effects(ROLLED[case]), len(commands),
        belief.step,
    )  # fmt: skip
    truth.reset(start)
    expected = torch.stack([torch.cat(truth.step(command)[:2]) for command in commands])
    generator = torch.Generator().manual_seed(0)
    found = ContactPredictor(belief).rollout(start, commands, generator, samples=3)
    assert torch.equal(found[0], found[2])
    torch.testing.assert_close(found[0], expected, rtol=0, atol=1e-4)
    plain = ContactPredictor(belief_with({}, episode)).rollout(start, commands, generator, 1)
    assert float((found[0] - plain[0]).abs().max()) > 5e-3


def test_rollouts_with_null_effects_are_those_without(episode: Episode) -> None:
    rolled = []
    for effects in ({}, {"floor_compliance": {}, "arm_friction": {}, "force_bias": {}}):
        predictor = ContactPredictor(belief_with(effects, episode))
        generator = torch.Generator().manual_seed(0)
        rolled.append(
            predictor.rollout(episode.poses[0] + 0.05, episode.commands[1:], generator, 2)
        )
    torch.testing.assert_close(*rolled, rtol=0, atol=1e-9)


def test_the_paper_has_a_model_of_its_own(wet: Effect) -> None:
    with pytest.raises(ValueError, match="paper has a model of its own"):
        Estimator(SHAPE, "paper", EstimatorSettings(effects=(wet,)))


def test_commands_take_a_model_and_go_on_with_no_other(
    folder: Path, episode: Episode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_episode(episode.first(2), tmp_path / "few.csv")
    model = tmp_path / "model.yaml"
    model.write_text("effects: [{name: force_bias}, {name: floor_tilt}]\n")
    words = (str(tmp_path / "few.csv"), "--prior", PRIOR, "--out", str(tmp_path / "run"))
    words = (*words, "--particles", "16")
    assert call("estimate", *words, "--model", str(model)) == 0
    printed = capsys.readouterr().out
    assert "floor_tilt.angle" in printed and "rad" in printed
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())["parameters"]
    assert summary["force_bias.tau"]["unit"] == "N·m"
    assert (tmp_path / "run" / "figures" / "estimation.png").stat().st_size > 5000
    for option in ((), ("--rollout", "--overwrite")):
        out = ("--out", str(tmp_path / "p.csv"), *option)
        assert call("predict", str(tmp_path / "run"), str(tmp_path / "few.csv"), *out) == 0
    capsys.readouterr()
    model.write_text("effects: [{name: force_bias}]\n")
    assert call("estimate", *words, "--model", str(model), "--resume") == 2
    assert "whose model is not the same" in capsys.readouterr().err
    assert call("estimate", *words, "--resume") == 2
    assert "whose model is not the same" in capsys.readouterr().err
    other = tmp_path / "moved.yaml"
    other.write_text("effects: [{name: force_bias}, {name: floor_tilt}]\n")
    (tmp_path / "run" / "results.json").unlink()
    assert call("estimate", *words, "--model", str(other), "--resume") == 0
    assert call("estimate", *words, "--model", str(model), "--estimator", "paper") == 2
    assert "leave --model out" in capsys.readouterr().err
