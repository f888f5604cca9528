"""What is known of the misfit counts where contact begins: data tell of a floor 1 mm closer than
theta says, and a command that ends between both is met by it.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.belief.filter import HistoryLikelihood, filter_history
from tpcd.belief.history import History, history_of
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.effects.catalogue import find_effect
from tpcd.parameters import Parameters
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings

CLOSER = 1e-3
"""By so much the object is met before theta says [m]."""
SD = torch.tensor([1e-3], dtype=torch.float64)
FIELD = MisfitField(sd=1e-3)


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["milk_carton"])


@pytest.fixture(scope="module")
def scene(shape: PolygonShape) -> ContactScene:
    theta = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.18]], dtype=torch.float64)
    return scene_from_parameters(shape, Parameters.from_vector(theta))


@pytest.fixture(scope="module")
def touched(scene: ContactScene) -> float:
    """Height of the end effector at which the object touches the floor, by theta [m]."""
    return -float(scene.points_ee[0, :, 1].min())


@pytest.fixture(scope="module")
def episode(touched: float) -> Episode:
    """Above the floor, pressed on it, above it, and 0.4 mm above where theta says it is."""
    heights = [touched + 0.01, touched - 0.004, touched + 0.01, touched + 0.4e-3]
    commands = torch.tensor([[0.0, z, 0.0] for z in heights], dtype=torch.float64)
    poses = commands.clone()
    poses[:, 1] = poses[:, 1].clamp_min(touched + CLOSER)
    stiffness = torch.tensor([1000.0, 1000.0, 30.0], dtype=torch.float64)
    noise = torch.tensor([5e-5, 5e-5, 1e-4, 0.05, 0.05, 0.01], dtype=torch.float64)
    return Episode(commands, poses, stiffness * (poses - commands), stiffness, noise)


@pytest.fixture(scope="module")
def history(episode: Episode) -> History:
    return history_of(episode)


def filtered(scene: ContactScene, history: History) -> HistoryLikelihood:
    setting = history.setting(scene)
    return filter_history(scene.points_ee, setting, SD, FIELD, StepSettings(), innovations=True)


def test_a_floor_known_to_be_closer_is_met_there(scene: ContactScene, history: History) -> None:
    found = filtered(scene, history)
    first, last = found.whitened[0, 0], found.whitened[0, 2]
    # The first touch is a surprise of one standard deviation of the misfit, the second one none.
    assert 0.8 < float(first.abs().max()) < 1.2
    assert float(last.abs().max()) < 0.1
    # Taken for free, the last command would have been 10 standard deviations off.
    assert 10 * float(history.variance[-1, 1].sqrt()) < CLOSER - 0.4e-3


@pytest.fixture(scope="module", params=[(), ("force_bias",)], ids=["", "with an effect"])
def belief(request, shape, scene, history: History, episode: Episode) -> Belief:
    """Of one particle, whose field is what the first two transitions say."""
    known = filtered(scene, history.first(2))
    prior = make_prior(shape, effects=[find_effect(name) for name in request.param])
    theta = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.18]], dtype=torch.float64)
    null = torch.zeros(1, len(prior.names) - theta.shape[1], dtype=torch.float64)
    return Belief(
        prior=prior,
        vectors=torch.cat((theta, null), dim=-1),
        weights=torch.ones(1, dtype=torch.float64),
        misfit=FIELD,
        misfit_sd=SD,
        misfit_mean=known.field_mean,
        misfit_covariance=known.field_covariance,
        step=StepSettings(),
        stiffness=episode.stiffness,
        log_evidence=0.0,
        log_evidence_std=0.0,
    )


def test_the_next_touch_is_predicted_there(belief: Belief, episode: Episode) -> None:
    found = ContactPredictor(belief).predict(
        episode.poses[2:3], episode.commands[3:], previous=episode.commands[2:3]
    )
    pose = episode.poses[3]
    torch.testing.assert_close(found.mean[0, :3], pose, atol=3e-5, rtol=0.0)
    assert 1e-5 < float(found.std[0, 1]) < 1e-4


def test_rollouts_meet_it_there(belief: Belief, episode: Episode) -> None:
    drawn = ContactPredictor(belief).rollout(
        episode.poses[2],
        episode.commands[3:],
        torch.Generator().manual_seed(0),
        samples=50,
        previous=episode.commands[2],
    )
    height: Tensor = drawn[:, 0, 1]
    assert abs(float(height.mean()) - float(episode.poses[3, 1])) < 5e-5
    assert 1e-5 < float(height.std()) < 1.5e-4
