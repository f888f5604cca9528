"""The paper's filter: its formulas, its bounds, and that it learns something."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tpcd.belief.belief import EstimationStep
from tpcd.belief.paper import (
    PaperSettings,
    estimate_paper,
    reflect,
    roughening_std,
    window_log_likelihood,
)
from tpcd.belief.prior import make_prior
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import Scene, draw_scene


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["mug"])


@pytest.fixture(scope="module")
def recorded(shape: PolygonShape) -> tuple[Episode, Scene]:
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", shape.outline.vertices, generator)
    motion = make_motion("rich", scene, 10, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 10, generator).measured, scene


@pytest.fixture(scope="module")
def steps(shape: PolygonShape, recorded: tuple[Episode, Scene]) -> list[EstimationStep]:
    settings = PaperSettings(particles=1500)
    return list(estimate_paper(recorded[0], shape, torch.Generator().manual_seed(0), settings))


def test_the_defaults_are_the_paper_s_numbers() -> None:
    settings = PaperSettings()
    assert (settings.particles, settings.memory, settings.roughness) == (5000, 5, 0.3)
    assert settings.covariance == (30.0, 30.0, 0.3, 1e-4, 1e-4, 0.002)
    assert settings.step.friction == "anitescu"


def test_the_window_is_a_product_of_one_step_likelihoods(
    shape: PolygonShape, recorded: tuple[Episode, Scene]
) -> None:
    episode, prior, settings = recorded[0], make_prior(shape), PaperSettings()
    vectors = prior.to_vector(prior.sample(4, torch.Generator().manual_seed(0)))
    found = window_log_likelihood(prior, vectors, episode, 3, 5, settings)
    scene = scene_from_parameters(shape, Parameters.from_vector(vectors))
    expected = torch.zeros(4, dtype=torch.float64)
    for k in (3, 4, 5):
        there = simulate_step(
            scene,
            episode.poses[k - 1],
            episode.commands[k],
            episode.stiffness,
            settings.step,
            previous=episode.commands[k - 1],
        )
        force, pose = episode.wrenches[k] - there.wrench, episode.poses[k] - there.pose
        expected -= 0.5 * (force[:, 0] ** 2 / 30 + force[:, 1] ** 2 / 30 + force[:, 2] ** 2 / 0.3)
        expected -= 0.5 * (
            pose[:, 0] ** 2 / 1e-4 + pose[:, 1] ** 2 / 1e-4 + pose[:, 2] ** 2 / 0.002
        )
    torch.testing.assert_close(found, expected)


def test_a_nan_particle_is_impossible_and_changes_no_other(
    shape: PolygonShape, recorded: tuple[Episode, Scene]
) -> None:
    prior, settings = make_prior(shape), PaperSettings()
    vectors = prior.to_vector(prior.sample(5, torch.Generator().manual_seed(0)))
    broken = vectors.clone()
    broken[2, 0] = torch.nan
    clean = window_log_likelihood(prior, vectors, recorded[0], 1, 5, settings)
    found = window_log_likelihood(prior, broken, recorded[0], 1, 5, settings)
    assert found[2] == -torch.inf
    others = torch.tensor([0, 1, 3, 4])
    torch.testing.assert_close(found[others], clean[others], atol=0, rtol=0)


def test_reflection_stays_in_the_box_and_leaves_what_is_inside() -> None:
    low, high = torch.tensor([-1.0, 2.0]).double(), torch.tensor([1.0, 3.0]).double()
    inside = torch.tensor([[0.2, 2.9], [-0.9, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(reflect(inside, low, high), inside)
    outside = torch.tensor([[1.25, 1.75], [-7.0, 5.5]], dtype=torch.float64)
    expected = torch.tensor([[0.75, 2.25], [1.0, 2.5]], dtype=torch.float64)
    torch.testing.assert_close(reflect(outside, low, high), expected)


def test_roughening_is_that_of_gordon_et_al() -> None:
    vectors = torch.tensor([[0.0, 1.0], [4.0, 1.0], [2.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    found = roughening_std(vectors, 0.3)
    expected = torch.tensor([0.3 * 4.0 * 4 ** (-0.5), 0.0], dtype=torch.float64)
    torch.testing.assert_close(found, expected)


def test_the_filter_resamples_when_it_should_and_keeps_to_the_box(
    steps: list[EstimationStep],
) -> None:
    for step in steps:
        belief, info = step.belief, step.info
        assert (info.effective_sample_size <= 750) == bool(info.rounds)
        assert float(belief.weights.sum()) == pytest.approx(1.0)
        assert (belief.vectors >= belief.prior.low).all()
        assert (belief.vectors <= belief.prior.high).all()
        assert belief.misfit_mean.shape == (1500, 0)
    assert any(step.info.rounds for step in steps)


def test_the_filter_learns_where_the_wall_is(
    steps: list[EstimationStep], recorded: tuple[Episode, Scene]
) -> None:
    def wall(step: EstimationStep) -> tuple[Tensor, Tensor]:
        return step.belief.mean()[-1], step.belief.std()[-1]

    truth = recorded[1].wall_position
    mean, std = wall(steps[-1])
    assert std < 0.8 * wall(steps[0])[1]
    assert abs(float(mean) - truth) < 3 * float(std)


@pytest.mark.parametrize(
    "wrong", [{"particles": 1}, {"covariance": (1.0, 2.0)}, {"roughness": -1.0}]
)
def test_settings_without_meaning_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PaperSettings(**wrong)
