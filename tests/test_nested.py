"""What one more effect gains, weighed on the draws of the model without it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import FIT_SAMPLER, Fit, Question
from tpcd.discrepancy.nested import NestedGain, nested_gain
from tpcd.discrepancy.screening import glance
from tpcd.effects import find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

SAMPLER = replace(
    FIT_SAMPLER,
    particles=200,
    draws_per_place=9,
    draws=600,
    prior_draws=100,
    fresh_modes=10,
    modes=4,
    rounds=1,
    places=20,
)
STIFFNESS = torch.tensor([1000.0, 1000.0, 50.0], dtype=torch.float64)
NOISE = torch.tensor([1e-4, 1e-4, 1e-3, 0.1, 0.1, 0.005], dtype=torch.float64)


def question_of(episode: Episode) -> Question:
    shape = PolygonShape(builtin_outlines()["mug"])
    history = joined_history([episode])
    return Question(history, make_prior(shape), MisfitField(0.0), StepSettings(), SAMPLER)


def in_free_space(bias: float, count: int = 13) -> Episode:
    """High above everything; the wrench is read with noise, and too high by `bias` [N] along x."""
    generator = torch.Generator().manual_seed(2)
    commands = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    noise = NOISE * torch.randn(count, 6, generator=generator, dtype=torch.float64)
    wrenches = noise[:, 3:] + torch.tensor([bias, 0.0, 0.0], dtype=torch.float64)
    return Episode(commands.expand(count, 3), commands + noise[:, :3], wrenches, STIFFNESS, NOISE)


@pytest.mark.parametrize("bias", [0.0, 0.3])
def test_in_free_space_a_bias_gains_what_the_integral_over_it_says(bias: float) -> None:
    """Poses settle at their commands, so that wrenches are the bias and noise of their own; but
    where the first step starts is known by what is read there alone."""
    episode = in_free_space(bias)
    question, effect = question_of(episode), find_effect("force_bias")
    base = fit_model(question, (), (0,))
    found = nested_gain(question, base, glance(question, base, effect, 8))
    expected = 0.0
    poses, wrenches = question.history.sensor_variance.split(3)
    variance = wrenches.repeat(len(episode.poses), 1)
    variance[0] += STIFFNESS**2 * poses
    read = episode.wrenches.clone()
    read[0] -= STIFFNESS * (episode.poses[0] - episode.commands[0])
    for axis, parameter in enumerate(effect.parameters):
        value = torch.linspace(parameter.low, parameter.high, 200_001, dtype=torch.float64)
        rise = (value * read[:, axis, None] - 0.5 * value**2) / variance[:, axis, None]
        expected += float(rise.sum(0).exp().mean().log())
    assert found.std < 0.2
    assert found.gain == pytest.approx(expected, abs=4 * found.std + 0.05)
    assert (found.gain > 5) == (bias > 0)


@pytest.fixture(scope="module")
def contact() -> Question:
    """Steps on floor and wall, of a model that lacks nothing."""
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    truth = make_truth(scene, "quasistatic")
    motion = make_motion("rich", scene, 20, generator)
    return question_of(record(truth, scene, motion, 20, generator).measured)


@pytest.fixture(scope="module")
def base(contact: Question) -> Fit:
    """The model without effects."""
    return fit_model(contact, (), (0, 1))


@pytest.mark.parametrize("name", ["floor_compliance", "directional_friction"])
def test_the_gain_is_that_of_two_fits(contact: Question, base: Fit, name: str) -> None:
    effect = find_effect(name)
    found = nested_gain(contact, base, glance(contact, base, effect, 8))
    both = fit_model(contact, (effect,), (0, 1), start=(base,))
    assert base.spread < 0.5 and both.spread < 0.5
    expected = both.log_evidence - base.log_evidence
    assert found.gain == pytest.approx(expected, abs=4 * found.std + 0.5)
    assert found.gain < 0 and found.std < 0.3


def test_an_effect_that_is_there_gains_what_two_fits_say_beside_another_effect() -> None:
    """The floor yields, in a scene that is found by a model with another effect that is there."""
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    hidden = {"directional_friction": {"log_ratio": 0.1}, "floor_compliance": {"compliance": 2e-4}}
    truth = make_truth(scene, "quasistatic", hidden, 20)
    motion = make_motion("rich", scene, 20, generator)
    question = question_of(record(truth, scene, motion, 20, generator).measured)
    known, asked = (find_effect(name) for name in hidden)
    base = fit_model(question, (known,), (0,))
    both = fit_model(question, (known, asked), (0,), start=(base,))
    found = nested_gain(question, base, glance(question, base, asked, 8))
    expected = both.log_evidence - base.log_evidence
    assert found.gain == pytest.approx(expected, abs=4 * found.std + 0.5)
    assert found.gain > 5 and found.std < 0.5


def test_few_draws_tell_nothing(contact: Question, base: Fit) -> None:
    """Two draws of a model, or one that has nearly all of the weight, know no spread."""
    look = glance(contact, base, find_effect("wall_tilt"), 0)
    cloud = base.clouds[0]
    weights = torch.full_like(cloud.weights, 1e-9)
    weights[0] = 1.0
    alone = replace(cloud, weights=weights / weights.sum())
    two = replace(
        cloud,
        positions=cloud.positions[:2],
        weights=torch.full((2,), 0.5).double(),
        log_likelihood=cloud.log_likelihood[:2],
    )
    for few in (alone, two):
        fit = replace(base, by_seed=base.by_seed[:1], clouds=(few,))
        assert nested_gain(contact, fit, look).std == math.inf


def test_seeds_count_by_their_evidence(base: Fit) -> None:
    """In gains, not in what is reported; one that missed 3 nats does not count."""
    one, other = (replace(c, log_evidence=e) for c, e in zip(base.clouds, (10.0, 9.0), strict=True))
    fit = replace(base, by_seed=(10.0, 9.0), clouds=(one, other))
    share = float(fit.cloud_by_evidence.weights[: len(one.weights)].sum())
    assert share == pytest.approx(1 / (1 + math.exp(-1)), abs=1e-4)
    assert float(fit.cloud.weights[: len(one.weights)].sum()) == pytest.approx(0.5, abs=1e-4)
    missed = replace(fit, by_seed=(10.0, 6.0))
    assert len(missed.cloud_by_evidence.weights) == len(one.weights)


def test_what_nothing_excites_gains_nothing(contact: Question) -> None:
    """Without a wall no draw of the friction there changes the likelihood."""
    bounds = {"wall_position": (5.0, 5.1)}
    away = replace(contact, scene=make_prior(contact.scene.shape, bounds))
    effect = find_effect("wall_friction")
    base = fit_model(away, (), (0,))
    found = nested_gain(away, base, glance(away, base, effect, 0))
    assert found.gain == pytest.approx(0.0, abs=0.15)


def test_the_same_question_has_the_same_answer(contact: Question, base: Fit) -> None:
    look = glance(contact, base, find_effect("wall_tilt"), 0)
    assert nested_gain(contact, base, look) == nested_gain(contact, base, look)


def test_an_effect_that_explains_nothing_at_all_has_no_weight(
    contact: Question, base: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = glance(contact, base, find_effect("wall_tilt"), 0)
    monkeypatch.setattr(
        "tpcd.belief.target.ContactTarget.log_likelihood",
        lambda target, score, least: torch.full((len(score),), -torch.inf).double(),
    )
    assert nested_gain(contact, base, look) == NestedGain(-math.inf, math.inf)
