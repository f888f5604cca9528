"""The absolute test of a model: how often it finds something left by the model that is true."""

from __future__ import annotations

import torch

from tpcd.belief.cloud import start_cloud
from tpcd.belief.history import history_of
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import check_adequacy
from tpcd.discrepancy.fit import Fit, Question
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import ContactMode, StepSettings, rollout

STIFFNESS = torch.tensor([1000.0, 1000.0, 50.0], dtype=torch.float64)
NOISE = torch.tensor([2e-4, 2e-4, 5e-4, 0.2, 0.2, 0.02], dtype=torch.float64)
PRIOR = make_prior(PolygonShape(builtin_outlines()["mug"]))
#: scale, mount (x, z, phi), friction, floor, wall
TRUTH = torch.tensor([1.0, 0.0, 0.0, 0.05, 0.5, -0.01, 0.12], dtype=torch.float64)


def test_where_the_wall_holds_an_object_a_true_model_leaves_nothing() -> None:
    """There x is read with noise alone, of which an innovation must not be told to depend on it."""
    count, seeds = 40, 60
    scene = scene_from_parameters(PRIOR.shape, Parameters.from_vector(TRUTH[None]))
    start = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    force = torch.linspace(0.0, 3.0, count - 1, dtype=torch.float64).sin().abs()
    commands = start.repeat(count, 1)
    commands[1:, 0] = 0.11 + 0.002 * force
    steps = rollout(scene, start[None], commands[1:, None], STIFFNESS, previous=start[None])
    held = [int(step.mode[0, 1]) == int(ContactMode.STICK) for step in steps]
    assert sum(held) > 0.8 * len(held)
    poses = torch.cat((start[None], *(step.pose for step in steps)))
    score = torch.cat((PRIOR.to_score(TRUTH), torch.zeros(1).double()))[None]
    fit = Fit((), StepSettings(), PRIOR, (0.0,), (start_cloud(score),))
    chances = []
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        noise = NOISE * torch.randn(count, 6, generator=generator, dtype=torch.float64)
        wrenches = STIFFNESS * (poses - commands) + noise[:, 3:]
        episode = Episode(commands, poses + noise[:, :3], wrenches, STIFFNESS, NOISE)
        question = Question(history_of(episode), PRIOR, MisfitField(0.0), StepSettings())
        chances.append(check_adequacy(question, fit, generator).cells_p)
    p = torch.tensor(chances)
    # With a chance of 5 % each, more than seven of 60 would be so in one of a hundred cases.
    assert int((p < 0.05).sum()) <= 7
    assert 0.35 < float(p.median()) < 0.65
