"""What tests of effects share: the example of the docs, an episode, and its likelihood."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from command_calls import ROOT
from torch import Tensor

from tpcd.belief.history import History
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.data.episode import Episode
from tpcd.effects.model import load_model
from tpcd.effects.protocol import Added
from tpcd.errors import ModelError
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

DOCS = (ROOT / "tpcd" / "effects" / "README.md").read_text(encoding="utf-8")
SHAPE = PolygonShape(builtin_outlines()["mug"])


def block(language: str) -> str:
    """The one block of a language in the docs."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", DOCS, re.DOTALL)
    return found


def make_episode() -> Episode:
    """Six steps of a mug."""
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("diagnosis", scene, 6, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 6, generator).measured


def likelihood(history: History, draws: Tensor, added: Added | None) -> Tensor:
    """Log likelihood of a history for draws of theta of a mug."""
    sd = torch.full((len(draws),), 5e-4, dtype=torch.float64)
    parameters, field = Parameters.from_vector(draws), MisfitField(5e-4)
    return history_likelihood(
        SHAPE, parameters, sd, history, field, StepSettings(), added=added
    ).total


def draws_of(count: int) -> Tensor:
    """Draws of theta from the prior."""
    prior = make_prior(SHAPE)
    return prior.to_vector(prior.sample(count, torch.Generator().manual_seed(1)))


def one_line(error: BaseException) -> str:
    """The message of an error, which has one line."""
    line = str(error)
    assert "\n" not in line
    return line


def refused_model(folder: Path, text: str) -> str:
    """What is said of a model file that holds the text."""
    path = folder / "model.yaml"
    path.write_text(text)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    told = one_line(caught.value)
    assert str(path) in told
    return told
