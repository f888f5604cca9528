"""What effects do to the data beyond theta: which are alike, and from which size on they show."""

from __future__ import annotations

import pytest
import torch
from diagnosis_bench import SETTINGS

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.discrepancy.confusion import FAINT, SHARES, confusions, reach_of, signatures
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.effects import find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import Policy, make_motion, record
from tpcd.truth.scene import draw_scene


def fitted(policy: Policy) -> tuple[Question, Fit]:
    """A mug of known outline that was moved so, and the model without effects."""
    outline = builtin_outlines()["mug"]
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", outline.vertices, generator)
    motion = make_motion(policy, scene, 60, generator)
    truth = make_truth(scene, "quasistatic", {}, 60)
    episode = record(truth, scene, motion, 60, generator).measured
    question = Question(
        joined_history([episode]),
        make_prior(PolygonShape(outline)),
        MisfitField(1e-4, 1.0),
        StepSettings(),
        SETTINGS.sampler,
    )
    return question, fit_model(question, (), (0,))


@pytest.fixture(scope="module")
def rich() -> tuple[Question, Fit]:
    return fitted("diagnosis")


def test_effects_that_do_the_same_to_the_data_are_called_confusions() -> None:
    one = torch.tensor([[0.0, 3.0, 4.0]], dtype=torch.float64)
    plane = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    found = confusions({"a": one, "b": plane, "weak": 0.1 * one})
    assert [(c.name, c.other) for c in found] == [("a", "b"), ("a", "weak")]
    assert found[0].likeness == pytest.approx(1.0)
    # Of b's first direction, a explains 3 / 5.
    assert confusions({"b": 2 * plane, "a": one})[0].name == "a"


def test_press_and_slide_hardly_tell_gain_from_stiffness(rich: tuple[Question, Fit]) -> None:
    alike = []
    for question, fit in (rich, fitted("press_and_slide")):
        effects = [find_effect(n) for n in ("force_gain", "stiffness_error")]
        own, other = signatures(question, fit, effects).values()
        span = torch.linalg.qr(other.T).Q
        alike.append(float((span.T @ own[0]).norm() / own[0].norm()))
    assert alike[1] > alike[0] + 0.03


def test_what_holds_until_it_slips_is_changed_by_more(rich: tuple[Question, Fit]) -> None:
    question, fit = rich
    effect = find_effect("static_kinetic")
    first = signatures(question, fit, [effect])[effect.name]
    ((*reach,),) = reach_of(question, fit, effect, first)
    assert reach[0][1] == pytest.approx(float(first.norm())) and reach[0][1] < FAINT
    assert [size for size, _ in reach] == pytest.approx(SHARES)  # of a prior of width 1
    third = signatures(question, fit, [effect], SHARES[2])[effect.name]
    assert reach[2][1] == pytest.approx(float(third.norm())) and reach[2][1] > 2 * FAINT


def test_a_bias_moves_what_pose_and_wrench_say_of_each_other(rich: tuple[Question, Fit]) -> None:
    """By itself over the noise of w - K (x - u), in every row that was read. Torque tells the angle
    as well as its sensor does, so that a bias moves the pose that both say, and contact with it."""
    question, fit = rich
    effect = find_effect("force_bias")
    first = signatures(question, fit, [effect])[effect.name]
    history = question.history
    variance = history.sensor_variance[3:] + history.stiffness**2 * history.sensor_variance[:3]
    for k, ((size, norm),) in enumerate(reach_of(question, fit, effect, first)):
        parameter = effect.parameters[k]
        assert size == pytest.approx(SHARES[0] * (parameter.high - parameter.low))
        alone = size * (int(history.read.sum()) / float(variance[k])) ** 0.5
        assert norm == pytest.approx(alone, rel=0.05) if k < 2 else norm > 1.2 * alone
