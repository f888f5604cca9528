"""The motion that would decide between two models."""

from __future__ import annotations

import pytest
import torch

from tpcd.belief.history import joined_history
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import SamplerSettings
from tpcd.data.episode import Episode
from tpcd.discrepancy.deciding import deciding_motion
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import Fit, Question
from tpcd.effects import find_effect
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

SAMPLER = SamplerSettings(
    rough=False, particles=100, draws=400, prior_draws=100, fresh_modes=12, modes=6, places=24
)


@pytest.fixture(scope="module")
def episode() -> Episode:
    """Pressed onto the floor and moved to the right, up to the wall, which is another surface."""
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    truth = make_truth(scene, "quasistatic", {"wall_friction": {"log_ratio": -0.6}}, 25)
    motion = make_motion("press_and_slide", scene, 25, generator)
    return record(truth, scene, motion, 25, generator).measured


@pytest.fixture(scope="module")
def question(episode: Episode) -> Question:
    shape = PolygonShape(builtin_outlines()["mug"])
    return Question(
        joined_history([episode]), make_prior(shape), MisfitField(0.0), StepSettings(), SAMPLER
    )


@pytest.fixture(scope="module")
def base(question: Question) -> Fit:
    return fit_model(question, (), (0,))


def test_another_wall_is_told_from_another_way_on_the_wall(
    question: Question, base: Fit, episode: Episode
) -> None:
    wall, way = (
        fit_model(question, (find_effect(name),), (0,), start=(base,))
        for name in ("wall_friction", "directional_friction")
    )
    told = deciding_motion(question, wall, way, episode)
    assert "the wall" in told and "nats each time" in told
    assert told == deciding_motion(question, wall, way, episode)


def test_nothing_tells_a_model_from_itself(question: Question, base: Fit, episode: Episode) -> None:
    told = deciding_motion(question, base, base, episode)
    assert told == "no move of the diagnosis motion tells them apart"
