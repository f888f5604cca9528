"""Model files and effects of one's own: the example of the docs, and all that can go wrong."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, ROOT, call
from torch import Tensor

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.belief import Belief, prior_belief
from tpcd.belief.history import History, history_of
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.storage import load_belief, save_belief
from tpcd.data.episode import Episode, write_episode
from tpcd.effects import CATALOGUE, DeclaredEffect, Effect, EffectParameter
from tpcd.effects.check import check_effect
from tpcd.effects.model import Model, load_effects, load_model, write_model
from tpcd.effects.protocol import Added
from tpcd.effects.truth import EffectTruth, added_effects
from tpcd.errors import EffectError, ModelError
from tpcd.exploration import Estimator
from tpcd.parameters import Parameters
from tpcd.predict import ContactPredictor
from tpcd.results import to_plain
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, native
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

DOCS = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
STIFFNESS = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
BOX = torch.tensor([[-0.05, 0.0], [0.05, 0.0], [0.05, 0.1], [-0.05, 0.1]]).double()
SHAPE = PolygonShape(builtin_outlines()["mug"])
FEW = SamplerSettings(particles=32, draws=200, prior_draws=100, places=10, fresh_modes=8)


def block(language: str) -> str:
    """The one block of a language in the docs."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", DOCS, re.DOTALL)
    return found


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
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("diagnosis", scene, 6, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 6, generator).measured


def likelihood(history: History, draws: Tensor, added: Added | None) -> Tensor:
    sd = torch.full((len(draws),), 5e-4, dtype=torch.float64)
    parameters, field = Parameters.from_vector(draws), MisfitField(5e-4)
    return history_likelihood(
        SHAPE, parameters, sd, history, field, StepSettings(), added=added
    ).total


def draws_of(count: int) -> Tensor:
    prior = make_prior(SHAPE)
    return prior.to_vector(prior.sample(count, torch.Generator().manual_seed(1)))


def one_line(error: BaseException) -> str:
    line = str(error)
    assert "\n" not in line
    return line


def test_the_example_of_the_docs_is_a_model(folder: Path) -> None:
    model = load_model(folder / "model.yaml")
    assert [effect.name for effect in model.effects] == ["wet_floor", "floor_compliance"]
    assert [(p.low, p.high) for p in model.effects[0].parameters] == [(-1.5, 1.5), (0.0, 0.1)]
    assert model.step == StepSettings(substeps=4)
    assert "beyond 50 mm" in model.effects[0].sentence(["-0.7", "50 mm"])


@pytest.mark.parametrize("compiled", [True, False])
def test_the_example_changes_no_bit_at_its_null_values(
    wet: Effect, episode: Episode, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled:
        monkeypatch.setattr(native, "available", lambda: False)
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


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.name)
def test_the_catalogue_keeps_its_promises(effect: Effect) -> None:
    check_effect(effect)


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


def test_models_come_back_as_they_were_written(folder: Path, tmp_path: Path) -> None:
    model = load_model(folder / "model.yaml")
    again = load_model(write_model(model, tmp_path / "deep.yaml", notes="by hand"))
    assert again.step == model.step
    assert [to_plain(effect) for effect in again.effects] == to_plain(model.effects)
    assert load_model(write_model(Model(), tmp_path / "none.yaml")) == Model()


def test_settings_with_effects_are_plain_and_readable(wet: Effect) -> None:
    plain = to_plain(EstimatorSettings(effects=(wet, CATALOGUE[0])))
    assert plain["effects"][1] == {
        "name": "floor_compliance",
        "parameters": {"compliance": [0.0, 8e-4]},
    }
    json.dumps(plain)


FAULTS = {
    "no file": (None, "no such file"),
    "a folder": ("", "cannot be read"),
    "no YAML": ("effects: [", "cannot be read"),
    "a list": ("- floor_tilt", "is not a mapping"),
    "another key": ("effect: []", "has 'effect'"),
    "no list": ("effects: floor_tilt", "expected a list"),
    "no name": ("effects: [floor_tilt]", "expected at least 'name: ...'"),
    "an unknown key": (
        "effects: [{name: floor_tilt, prior: [0, 1]}]",
        "expected name, file and parameters",
    ),
    "unknown effect": ("effects: [{name: floor_till}]", "no effect 'floor_till'; expected one of"),
    "unknown parameter": (
        "effects: [{name: floor_tilt, parameters: {slope: [0, 1]}}]",
        "effect 'floor_tilt' has no 'slope'; expected angle",
    ),
    "twice": ("effects: [{name: floor_tilt}, {name: floor_tilt}]", "'floor_tilt' twice"),
    "no width": ("effects: [{name: floor_tilt, parameters: {angle: [1, 1]}}]", "low < high"),
    "infinite": ("effects: [{name: floor_tilt, parameters: {angle: [0, .inf]}}]", "finite"),
    "one end": (
        "effects: [{name: floor_tilt, parameters: {angle: [1]}}]",
        "prior of floor_tilt.angle is [1], expected [low, high]",
    ),
    "a word": ("effects: [{name: floor_tilt, parameters: {angle: [0, steep]}}]", "[low, high]"),
    "a number": ("effects: [{name: floor_tilt, parameters: {angle: 3}}]", "is 3, expected [low"),
    "no mapping": ("effects: [{name: floor_tilt, parameters: 3}]", "expected 'name: [low, high]'"),
    "unknown step": ("step: {parts: 3}", "expected any of friction, substeps"),
    "bad step": ("step: {substeps: 0}", "must both be at least 1"),
    "no effects file": ("effects: [{name: a, file: nowhere.py}]", "nowhere.py: no such file"),
    "no EFFECTS": ("effects: [{name: a, file: empty.py}]", "empty.py: holds no EFFECTS"),
    "failing file": (
        "effects: [{name: a, file: failing.py}]",
        "failing.py: fails when it is run: ZeroDivisionError: division by zero",
    ),
    "no Python": ("effects: [{name: a, file: broken.py}]", "fails when it is run: SyntaxError"),
    "no effect": ("effects: [{name: a, file: other.py}]", "EFFECTS holds 3"),
    "other name": (
        "effects: [{name: dry_floor, file: my_effects.py}]",
        "expected one of wet_floor",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_models_are_refused_in_one_line(folder: Path, tmp_path: Path, fault: str) -> None:
    text, told = FAULTS[fault]
    (tmp_path / "my_effects.py").write_text(block("python"))
    (tmp_path / "empty.py").write_text("x = 1\n")
    (tmp_path / "failing.py").write_text("1 / 0\n")
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "other.py").write_text("EFFECTS = (3,)\n")
    path = tmp_path if text == "" else tmp_path / "model.yaml"
    if text:
        path.write_text(text)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert told in one_line(caught.value)
    assert str(tmp_path) in str(caught.value)


SPOILT = {
    "not null": ("torch.exp(log_ratio * beyond)", "1.0 + torch.exp(log_ratio * beyond)"),
    "mixes": ("(x - edge)", "(x - edge.mean())"),
    "no passes": ("        passes=1,\n", ""),
    "no text": ("{1}", "{2}"),
    "site": ('"contact tangent"', '"contact"'),
    "raises": ("    x = ", "    raise RuntimeError('on\\npurpose')\n    x = "),
    "nothing": ("    return replace(conditions, friction=conditions.friction * ratio)", "    pass"),
    "shape": ("conditions.friction * ratio", "ratio[..., 0]"),
    "dtype": ("conditions.friction * ratio", "(conditions.friction * ratio).float()"),
    "null": ("null=0.05", "null=0.5"),
}
TOLD = {
    "not null": "changes friction at the null values",
    "mixes": "mixes particles: friction of the first depends on the others",
    "no passes": "expected 'passes' of 1 or more",
    "no text": "expected {0}, {1}",
    "site": "expected one of command, impedance",
    "raises": "'wet_floor' fails with RuntimeError: on purpose",
    "nothing": "'wet_floor'",
    "shape": "'wet_floor'",
    "dtype": "'wet_floor'",
    "null": "null value 0.5 of 'edge' outside of its range",
}


@pytest.mark.parametrize("case", TOLD)
def test_effects_that_break_their_promises_are_refused_when_read(tmp_path: Path, case: str) -> None:
    before, after = SPOILT[case]
    assert block("python").count(before) == 1
    path = tmp_path / "own.py"
    path.write_text(block("python").replace(before, after))
    with pytest.raises(ModelError) as caught:
        load_effects(path)
    assert TOLD[case] in one_line(caught.value) and "own.py" in str(caught.value)


def test_an_effect_may_not_come_twice_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(block("python") + "\nEFFECTS = EFFECTS * 2\n")
    with pytest.raises(ModelError, match="holds 'wet_floor' twice"):
        load_effects(path)


def rough(power: float, field: str = "friction") -> Effect:
    """An effect that has no answer for negative values."""

    def change(conditions, values, rows, outcome):
        value = getattr(conditions, field)
        factor = (values[:, 0] ** power).reshape(-1, *[1] * (value.ndim - 1))
        return replace(conditions, **{field: value * factor})

    return DeclaredEffect(
        "rough", "contact tangent", (EffectParameter("size", "1", -1.0, 1.5, 1.0),), change, "{0}"
    )


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("field", ["friction", "command", "stiffness", "normal", "bias"])
def test_a_particle_without_an_answer_leaves_the_others_alone(
    episode: Episode, compiled: bool, field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiled:
        monkeypatch.setattr(native, "available", lambda: False)
    values = torch.tensor([-0.5, 1.0, 0.9, -0.1, 1.2, 1.0], dtype=torch.float64)[:, None]
    fine = values[:, 0] > 0
    rows = episode if compiled else episode.first(3)
    effect, history, draws = rough(0.5, field), history_of(rows), draws_of(6)
    # A second effect looks at what the first one left behind.
    pair = (effect, CATALOGUE[0])
    values = torch.cat((values, torch.full_like(values, 2e-4)), dim=1)
    found = likelihood(history, draws, Added(pair, values))
    other = values.clone()
    other[~fine, 0] = 1.0
    expected = likelihood(history, draws, Added(pair, other))
    assert torch.equal(found[fine], expected[fine])
    assert bool((found[~fine] == -torch.inf).all())


def test_a_stiffness_that_is_not_positive_counts_as_no_answer(episode: Episode) -> None:
    values = torch.tensor([[1.0], [-1.0], [1.0]], dtype=torch.float64)
    found = likelihood(history_of(episode), draws_of(3), Added((rough(1.0, "stiffness"),), values))
    expected = likelihood(history_of(episode), draws_of(3), None)
    assert torch.equal(found[[0, 2]], expected[[0, 2]])
    assert float(found[1]) == -torch.inf


def test_an_effect_that_never_has_an_answer_is_named(episode: Episode) -> None:
    effect = replace(
        rough(1.0), change=lambda c, v, r, o: replace(c, friction=c.friction * torch.nan)
    )
    values = torch.ones(3, 1, dtype=torch.float64)
    with pytest.raises(EffectError, match="'rough' gives no usable friction for any value"):
        likelihood(history_of(episode), draws_of(3), Added((effect,), values))
    only_bad = rough(0.5)
    found = likelihood(history_of(episode), draws_of(3), Added((only_bad,), -values))
    assert bool((found == -torch.inf).all())


def test_an_effect_that_fails_on_the_way_is_named(episode: Episode) -> None:
    def change(conditions, values, rows, outcome):
        raise IndexError("a cause\nof two lines")

    effect = replace(rough(1.0), change=change, source="own.py")
    with pytest.raises(EffectError) as caught:
        likelihood(history_of(episode), draws_of(2), Added((effect,), torch.ones(2, 1).double()))
    line = one_line(caught.value)
    assert line == "effect 'rough' of own.py fails with IndexError: a cause of two lines"


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
    assert "another model" in capsys.readouterr().err
    assert call("estimate", *words, "--resume") == 2
    assert "another model" in capsys.readouterr().err
    other = tmp_path / "moved.yaml"
    other.write_text("effects: [{name: force_bias}, {name: floor_tilt}]\n")
    assert call("estimate", *words, "--model", str(other), "--resume") == 0
    assert call("estimate", *words, "--model", str(model), "--estimator", "paper") == 2
    assert "leave --model out" in capsys.readouterr().err
