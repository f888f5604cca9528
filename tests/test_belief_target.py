"""Derivatives of the contact posterior against automatic ones and differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from contact_scenes import STIFFNESS, flush_corner
from torch import Tensor

from tpcd.belief.history import history_of
from tpcd.belief.likelihood import effective_setting
from tpcd.belief.linearised import Linearised, linearised_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.setting import Merged
from tpcd.belief.target import ContactTarget
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.effects.catalogue import find_effect
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, StepStatus, simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

STEPS = 8
"""With fewer, no change of contact is located on a path (see `walk`)."""
FIELD = MisfitField(1e-3, 1.0, grain=0.2, roughness=15.0)


@pytest.fixture(scope="module")
def prior() -> ParameterPrior:
    return make_prior(PolygonShape(builtin_outlines()["mug"]))


@pytest.fixture(scope="module")
def truth_and_episode(prior: ParameterPrior) -> tuple[Tensor, Episode]:
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", prior.shape.outline.vertices, generator)
    motion = make_motion("rich", scene, STEPS, generator)
    episode = record(make_truth(scene, "quasistatic"), scene, motion, STEPS, generator).measured
    theta = torch.tensor(list(scene.theta.values()), dtype=torch.float64)
    return prior.to_score(theta), episode


@pytest.mark.parametrize("friction", ["coulomb", "anitescu"])
@pytest.mark.parametrize("substeps", [1, 4])
def test_settled_poses_move_with_theta_as_automatic_derivatives_say(
    prior: ParameterPrior,
    truth_and_episode: tuple[Tensor, Episode],
    friction: str,
    substeps: int,
) -> None:
    """Against readings without weight, the innovation is minus the pose in known units."""
    truth, episode = truth_and_episode
    settings = StepSettings(friction=friction, substeps=substeps)
    history = history_of(episode)
    noise = torch.randn(8, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    vectors, slopes = prior.to_vector_with_slope(truth + 0.2 * noise)
    compared = located = 0
    for k in range(STEPS):
        unit = 1e4
        known = torch.tensor([[1e-20], [1.0]], dtype=torch.float64).expand(2, 3)
        merged = {name: value[:, k : k + 2] for name, value in vars(history.merged).items()}
        one = replace(
            history.first(1),
            commands=history.commands[k : k + 2],
            readings=history.readings[k : k + 2],
            merged=Merged(**{**merged, "variance": unit**2 * known[None]}),
        )
        found = linearised_likelihood(
            prior.shape, vectors, slopes, torch.zeros(8).double(), one, MisfitField(0.0), settings
        ).found
        theta = vectors.clone().requires_grad_()
        there = simulate_step(
            scene_from_parameters(prior.shape, Parameters.from_vector(theta)),
            one.start[0],
            one.command[0],
            one.stiffness,
            settings,
            previous=one.previous[0],
        )
        whole = simulate_step(
            scene_from_parameters(prior.shape, Parameters.from_vector(vectors)),
            one.start[0],
            one.command[0],
            one.stiffness,
            replace(settings, finest=1.0),
            previous=one.previous[0],
        )
        located += int(((whole.pose - there.pose).detach().abs().amax(-1) > 1e-6).sum())
        usable = there.status == int(StepStatus.CONVERGED)
        for a in range(3):
            (expected,) = torch.autograd.grad(there.pose[:, a].sum(), theta, retain_graph=True)
            difference = (-unit * found.slopes[:, :, 0, a] - expected * slopes)[usable]
            assert difference.abs().max() < 2e-5 * (1 + (expected * slopes).abs().max())
            compared += int((expected[usable].abs().amax(-1) > 1e-3).sum())
    assert compared > 40
    assert located > 2 or substeps == 1 or friction == "anitescu"


def test_friction_that_is_left_out_moves_nothing() -> None:
    """What jams in a corner is answered without friction, where it rests before it sets out too."""
    settings = StepSettings(friction="anitescu")
    prior, vectors, start, before, command = flush_corner(100)
    friction = prior.names.index("friction")
    vectors[:, friction] = 1.2 + 2.0 * (vectors[:, friction] - 0.2) / 0.7
    poses, commands = torch.stack((start, start)), torch.stack((before, command))
    noise = torch.tensor([2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02]).double()
    episode = Episode(commands, poses, STIFFNESS * (poses - commands), STIFFNESS, noise)
    history = history_of(episode)
    found = linearised_likelihood(
        prior.shape,
        vectors,
        torch.ones_like(vectors),
        torch.zeros(100).double(),
        history,
        MisfitField(0.0),
        settings,
    ).found
    theta = vectors.clone().requires_grad_()
    scene = scene_from_parameters(prior.shape, Parameters.from_vector(theta))
    asked = (history.poses[0].expand(100, 3), command, STIFFNESS, settings)
    there = simulate_step(scene, *asked, previous=before)
    (expected,) = torch.autograd.grad(there.pose[:, 0].sum(), theta)
    unit = found.log_scale[:, 0, 0].exp()
    slopes = -unit * found.slopes[:, friction, 0, 0]
    assert (slopes - expected[:, friction]).abs().max() < 1e-4
    assert float(expected.abs().max()) > 1e-2


def test_derivatives_give_the_information_that_differences_give(
    prior: ParameterPrior,
    truth_and_episode: tuple[Tensor, Episode],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The change of the gain itself is left out: half of them agree to 10 %."""
    truth, episode = truth_and_episode
    target = ContactTarget(prior, FIELD, StepSettings()).given(history_of(episode))
    noise = torch.randn(20, 8, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    score = torch.cat((truth, torch.zeros(1).double())) + 0.02 * noise
    monkeypatch.setattr("tpcd.belief.target._DIFFERENCE", 1e-3)
    _, compiled = target.curvature(score)
    steps = torch.cat((torch.zeros(1, 8), 1e-3 * torch.eye(8))).double()[:, None]
    moved = target.evaluate((score + steps).flatten(0, 1), innovations=True)
    slopes, stretch = (
        ((part.unflatten(0, (9, 20))[1:] - part.unflatten(0, (9, 20))[0]) / 1e-3)
        .nan_to_num(0.0, 0.0, 0.0)
        .movedim(0, 1)
        .flatten(2)
        for part in (moved.whitened, moved.log_scale)
    )
    differences = slopes @ slopes.mT + 2 * stretch @ stretch.mT + torch.eye(8).double()
    error = torch.linalg.matrix_norm(compiled - differences)
    assert (error / torch.linalg.matrix_norm(differences)).median() < 0.1
    assert (torch.linalg.eigvalsh(compiled)[:, 0] > 0).all()


@pytest.mark.parametrize("count", [0, 1, 6])
def test_another_misfit_in_the_same_loops_is_as_by_itself(
    prior: ParameterPrior, truth_and_episode: tuple[Tensor, Episode], count: int
) -> None:
    """Also beside particles that are not finite, and for one or none."""
    truth, episode = truth_and_episode
    noise = torch.randn(count, 7, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    vectors, slopes = prior.to_vector_with_slope(truth + 0.3 * noise)
    sd = torch.linspace(5e-4, 3e-3, count, dtype=torch.float64)
    sd[4:5] = torch.nan
    moved = 1.5 * sd
    moved[2:3] = torch.nan

    def linearised(misfit_sd: Tensor, moved_sd: Tensor | None = None) -> Linearised:
        history = history_of(episode)
        arguments = (prior.shape, vectors, slopes, misfit_sd, history, FIELD, StepSettings())
        return linearised_likelihood(*arguments, moved_sd=moved_sd)

    both = linearised(sd, moved)
    here, there = linearised(sd).found, linearised(moved).found
    assert linearised(sd).moved_misfit is None and both.moved_misfit is not None
    exactly = {"rtol": 0.0, "atol": 0.0, "equal_nan": True}
    for name in ("total", "field_mean", "field_covariance", "whitened", "log_scale"):
        own, other = getattr(both.found, name), getattr(both.moved_misfit, name)
        torch.testing.assert_close(own, getattr(here, name), **exactly)
        torch.testing.assert_close(other, getattr(there, name), **exactly)
    torch.testing.assert_close(both.found.slopes, here.slopes, **exactly)
    assert both.moved_misfit.slopes is None
    assert both.found.total.isfinite().tolist() == [k != 4 for k in range(count)]
    assert both.moved_misfit.total.isfinite().tolist() == [k not in (2, 4) for k in range(count)]


@pytest.mark.parametrize("effects", [(), ("floor_compliance",)])
def test_derivatives_by_effects_and_the_misfit_s_size_are_differences_of_innovations(
    truth_and_episode: tuple[Tensor, Episode], effects: tuple[str, ...]
) -> None:
    truth, episode = truth_and_episode
    known = tuple(find_effect(name) for name in effects)
    prior = make_prior(PolygonShape(builtin_outlines()["mug"]), effects=known)
    target = ContactTarget(prior, FIELD, StepSettings()).given(history_of(episode))
    size = prior.dimension + 1
    noise = torch.randn(5, size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    score = torch.nn.functional.pad(truth, (0, size - len(truth))) + 0.1 * noise
    vectors, outcome = prior.to_vector(score[:, :-1]), None
    if known:
        scene = scene_from_parameters(prior.shape, prior.parameters_of(vectors))
        given = (scene, target.history, FIELD.sd_of(score[:, -1]), FIELD, target.step)
        _, outcome = effective_setting(*given, prior.added_of(vectors))
    found = target._linearised(score)
    here = target.evaluate(score, innovations=True, outcome=outcome)
    for entry in range(prior.scene_dimension, size):
        moved = score.clone()
        moved[:, entry] += 0.01
        there = target.evaluate(moved, innovations=True, outcome=outcome)
        for slopes, name in ((found.slopes, "whitened"), (found.stretch, "log_scale")):
            expected = (getattr(there, name) - getattr(here, name)) / 0.01
            steps = expected.shape[1]
            torch.testing.assert_close(slopes[:, entry, :steps], expected, rtol=1e-6, atol=1e-6)
            assert float(expected.abs().max()) > 1e-3


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_gradient_is_that_of_the_log_posterior(
    prior: ParameterPrior, truth_and_episode: tuple[Tensor, Episode], power: float
) -> None:
    """Up the gradient, scaled by the information, the log posterior rises nearly everywhere."""
    truth, episode = truth_and_episode
    target: ContactTarget = ContactTarget(prior, FIELD, StepSettings(), power=power).given(
        history_of(episode)
    )
    noise = torch.randn(30, 8, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    score = torch.cat((truth, torch.zeros(1).double())) + 0.02 * noise
    gradient, information = target.curvature(score)
    step = torch.linalg.solve(information, gradient)

    def height(points: Tensor) -> Tensor:
        return target.log_prior(points) + target.log_likelihood(points, None)

    gain = height(score + 1e-3 * step) - height(score)
    expected = 1e-3 * (gradient * step).sum(-1)
    assert (gain > 0).double().mean() > 0.8
    assert float((gain / expected).median()) == pytest.approx(1.0, abs=0.2)


def test_a_power_scales_the_likelihood_and_its_threshold(
    prior: ParameterPrior, truth_and_episode: tuple[Tensor, Episode]
) -> None:
    truth, episode = truth_and_episode
    whole = ContactTarget(prior, FIELD, StepSettings()).given(history_of(episode))
    half = replace(whole, power=0.5)
    noise = torch.randn(40, 8, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    score = torch.cat((truth, torch.zeros(1).double())) + 0.1 * noise
    full = whole.log_likelihood(score, None)
    torch.testing.assert_close(half.log_likelihood(score, None), 0.5 * full)
    least = full.nan_to_num(neginf=0.0) + torch.linspace(-9.0, 9.0, 40).double()
    kept = whole.log_likelihood(score, least)
    assert 0 < int((kept == -torch.inf).sum()) < 40
    torch.testing.assert_close(half.log_likelihood(score, 0.5 * least), 0.5 * kept)
    # What data say is halved, what is known before them is not.
    steep, flat = whole.curvature(score)[1], half.curvature(score)[1]
    own = torch.eye(8).double()
    torch.testing.assert_close(flat - own, 0.5 * (steep - own))
