"""What a diagnosis took for another shape: in the model file, and in what is estimated next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call, make_world
from effect_cases import SHAPE, make_episode, refused_model
from made_diagnosis import a_diagnosis

from tpcd.belief import EstimatorSettings, SamplerSettings
from tpcd.belief.augmented import shape_change_of
from tpcd.belief.belief import misfit_field, prior_belief, target_of
from tpcd.belief.history import history_of
from tpcd.belief.prior import make_prior
from tpcd.belief.storage import load_belief
from tpcd.data.episode import Episode
from tpcd.discrepancy.fit import FIT_SAMPLER, Question
from tpcd.discrepancy.memory import Memory
from tpcd.discrepancy.search import DiagnosisSettings, _question
from tpcd.discrepancy.variants import SCALES, WIDER_MISFIT, wide_shape
from tpcd.effects.model import Model, load_model, write_model
from tpcd.effects.shape_change import UNCHANGED, ShapeChange
from tpcd.parameters import DEFAULT_BOUNDS
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.protocol import Misfit
from tpcd.simulator import StepSettings

WIDE = ShapeChange((0.4, 2.4), WIDER_MISFIT)
FEW = SamplerSettings(particles=16)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return make_episode()


@pytest.mark.parametrize(
    "change", [UNCHANGED, WIDE, ShapeChange(misfit=2.0), ShapeChange((1.0, 3.0))]
)
def test_a_shape_comes_back_as_it_was_written(change: ShapeChange, tmp_path: Path) -> None:
    path = write_model(Model(shape=change), tmp_path / "model.yaml")
    assert load_model(path) == Model(shape=change)
    assert ("shape" in path.read_text()) is (change != UNCHANGED)


FAULTS = {
    "no mapping": ("3", "shape is 3, expected any of scale, misfit"),
    "another key": ("{size: [1, 2]}", "expected any of scale, misfit"),
    "one end": ("{scale: [1]}", "scale is [1], expected [low, high]"),
    "a number": ("{scale: 2}", "expected scale: [low, high]"),
    "a word": ("{scale: [0.5, large]}", "expected scale: [low, high]"),
    "no width": ("{scale: [2, 1]}", "0 < low < high"),
    "negative": ("{scale: [-1, 1]}", "0 < low < high"),
    "endless": ("{scale: [1, .inf]}", "0 < low < high"),
    "no misfit": ("{misfit: 0}", "misfit is 0.0, expected a number above 0"),
    "in other units": ("{misfit: 1.0e+9}", "expected a number above 0, up to 1000"),
    "not a number": ("{misfit: .nan}", "expected a number above 0"),
    "a list": ("{misfit: [1, 2]}", "misfit: a number"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_shapes_are_refused_in_one_line(fault: str, tmp_path: Path) -> None:
    text, told = FAULTS[fault]
    assert told in refused_model(tmp_path, f"shape: {text}")


@pytest.mark.parametrize("own", [{}, {"scale": (0.9, 1.1), "friction": (0.2, 0.4)}])
@pytest.mark.parametrize("taken", [False, True])
def test_an_estimate_expects_what_the_diagnosis_took(
    own: dict[str, tuple[float, float]], taken: bool, episode: Episode, tmp_path: Path
) -> None:
    """With a scale that the episode's own priors give or not."""
    episode, shape = replace(episode, priors=own), replace(SHAPE, misfit=Misfit(2e-3, 1.7))
    asked = Question(
        *(history_of(episode), make_prior(shape, own), misfit_field(shape, EstimatorSettings())),
        *(StepSettings(), FIT_SAMPLER),
    )
    asked = wide_shape(asked) if taken else asked
    before = prior_belief(episode, shape, torch.Generator(), EstimatorSettings(sampler=FEW))
    found = replace(before, prior=asked.scene, misfit=asked.misfit)
    change = shape_change_of(found, shape, own)
    scale = own.get("scale", DEFAULT_BOUNDS["scale"])
    wide = ShapeChange((SCALES[0] * scale[0], SCALES[1] * scale[1]), WIDER_MISFIT)
    assert change == (wide if taken else UNCHANGED)
    model = load_model(write_model(Model(shape=change), tmp_path / "model.yaml"))
    target = target_of(episode, shape, EstimatorSettings(shape=model.shape))
    assert torch.equal(target.prior.low, asked.scene.low)
    assert torch.equal(target.prior.high, asked.scene.high)
    assert target.misfit == asked.misfit


def test_a_misfit_that_is_given_is_taken_as_it_is() -> None:
    given = EstimatorSettings(misfit_sd=3e-3, shape=WIDE)
    assert misfit_field(SHAPE, given) == misfit_field(SHAPE, replace(given, shape=UNCHANGED))


@pytest.mark.parametrize("change", [UNCHANGED, WIDE])
def test_a_diagnosis_expects_the_same_as_an_estimate(change: ShapeChange, episode: Episode) -> None:
    question = _question([episode], SHAPE, DiagnosisSettings(shape=change), Memory())
    target = target_of(episode, SHAPE, EstimatorSettings(shape=change))
    assert torch.equal(question.scene.low, target.prior.low)
    assert torch.equal(question.scene.high, target.prior.high)
    assert question.misfit == target.misfit


def test_a_diagnosis_writes_what_it_took(episode: Episode, tmp_path: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.commands.diagnosing import write_diagnosis

    shape = load_prior(PRIOR)
    belief = prior_belief(
        episode, shape, torch.Generator(), EstimatorSettings(sampler=FEW, shape=WIDE)
    )
    found = replace(a_diagnosis(), belief=belief, belief_before=belief)
    change = shape_change_of(belief, shape, episode.priors)
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        write_diagnosis(found, [episode], 6.0, PRIOR, tmp_path, writer, change)
    assert load_model(tmp_path / "model.yaml").shape == WIDE


def test_commands_take_the_shape_and_go_on_with_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = make_world(tmp_path / "world")
    model, narrow = tmp_path / "model.yaml", tmp_path / "narrow.yaml"
    write_model(Model(shape=WIDE), model)
    write_model(Model(), narrow)
    episode, out = str(world / "explore.csv"), tmp_path / "run"
    words = ("--prior", PRIOR, "--particles", "32", "--out", str(out))
    assert call("estimate", episode, *words, "--model", str(model)) == 0
    plain, belief = load_belief(world / "run"), load_belief(out)
    place = belief.prior.names.index("scale")
    ends = belief.prior.low[place].item(), belief.prior.high[place].item()
    assert ends == WIDE.scale
    assert belief.misfit.sd == WIDE.misfit * plain.misfit.sd
    (out / "results.json").unlink()
    capsys.readouterr()
    assert call("estimate", episode, *words, "--model", str(narrow), "--resume") == 2
    assert "whose model is not the same" in capsys.readouterr().err
    given = (str(world / "run"), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    assert call("predict", *given, "--model", str(model)) == 0
    assert "the belief keeps its shape" in capsys.readouterr().out
