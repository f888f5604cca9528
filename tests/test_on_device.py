"""The same answers on an accelerator as on the CPU: `make test-device`.

On the CPU the compiled loops answer where there are any, so that torch and compiled code are
compared as well.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from contact_scenes import STIFFNESS, many_random_transitions, vector
from torch import Tensor

from eval.bench.contact_problems import random_contact_problems
from eval.bench.filter_step import decoded_scene, make_work, weights
from tpcd.belief.compiled import compiled_filter
from tpcd.belief.filtered import filter_history
from tpcd.belief.history import history_of
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import column_scene, scene_from_parameters
from tpcd.information import Outcomes, expected_information_gain, expected_variance
from tpcd.parameters import Parameters
from tpcd.qp import Status, solve
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, rollout, simulate_step
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene, make_truth

pytestmark = pytest.mark.device
COULOMB = StepSettings(friction="coulomb", substeps=10)


def moved(value: Any, device: torch.device) -> Any:
    """A tensor, or a record of tensors and of records, on the device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(moved(each, device) for each in value)
    if not is_dataclass(value):
        return value
    parts = {field.name: moved(getattr(value, field.name), device) for field in fields(value)}
    copy = object.__new__(type(value))
    for name, part in parts.items():
        object.__setattr__(copy, name, part)
    return copy


def same(found: Tensor, expected: Tensor, atol: float, allowed: int = 0) -> None:
    """Finite in the same elements and close there, all but `allowed` of the first axis."""
    found = found.cpu()
    assert found.shape == expected.shape
    good = torch.isclose(found, expected, rtol=0.0, atol=atol, equal_nan=True)
    bad = ~good.reshape(len(good), -1).all(-1)
    assert int(bad.sum()) <= allowed, f"{int(bad.sum())} of {len(bad)} differ"


@pytest.mark.parametrize("name", ["ycb21-z2", "ycb-rich"])
def test_the_prior_decodes_the_same_outlines(name: str, device: torch.device) -> None:
    shape = load_prior(name)
    latent = shape.sample_latent(300, torch.Generator().manual_seed(0))
    on_cpu, on_device = shape.boundary_points(latent), shape.boundary_points(latent.to(device))
    assert on_device.device.type == device.type
    same(on_device, on_cpu, 2e-6)
    # Draws are all valid; some of those around them are not.
    around = latent + 0.1 * torch.randn(latent.shape, generator=torch.Generator().manual_seed(1))
    valid = shape.valid(around)
    assert valid.any() and not valid.all()
    same(shape.valid(around.to(device)), valid, 0.0)
    same(shape.log_density(around.to(device)), shape.log_density(around), 1e-9)


def test_contact_problems_have_the_same_forces_and_gradients(device: torch.device) -> None:
    problem = random_contact_problems(2000, 16, seed=3)
    on_cpu, on_device = solve(problem), solve(moved(problem, device), engine="exact")
    assert on_device.motion.device.type == device.type
    assert bool((on_device.status == int(Status.SOLVED)).all())
    same(on_device.motion, on_cpu.motion, 1e-12)
    same(on_device.multipliers, on_cpu.multipliers, 1e-8)
    gradients = []
    for place in (torch.device("cpu"), device):
        target = problem.target.detach().to(place).requires_grad_()
        answer = solve(replace(moved(problem, place), target=target), engine="exact")
        (gradient,) = torch.autograd.grad(answer.motion.square().sum(), target)
        gradients.append(gradient.cpu())
    same(gradients[1], gradients[0], 1e-9)


def test_one_bad_problem_changes_no_other(device: torch.device) -> None:
    problem = random_contact_problems(50, 16, seed=4)
    spoilt = problem.target.clone()
    spoilt[7] = torch.nan
    bad = replace(moved(problem, device), target=spoilt.to(device))
    expected, found = solve(problem), solve(bad, engine="exact")
    assert int(found.status[7]) != int(Status.SOLVED)
    others = torch.arange(50) != 7
    same(found.motion.cpu()[others], expected.motion[others], 1e-12)


@pytest.mark.parametrize("settings", [StepSettings(friction="anitescu", substeps=1), COULOMB])
def test_transitions_end_at_the_same_poses(settings: StepSettings, device: torch.device) -> None:
    scene, start, command = many_random_transitions(100, seed=5)
    on_cpu = simulate_step(scene, start, command, STIFFNESS, settings)
    given = (moved(each, device) for each in (scene, start, command, STIFFNESS))
    on_device = simulate_step(*given, settings, engine="torch")
    # As far as either engine settles a step; one of these ends just short of that.
    same(on_device.pose, on_cpu.pose, 3e-6)
    same(on_device.wrench, on_cpu.wrench, 3e-4)
    same(on_device.status, on_cpu.status, 0.0, allowed=2)


def test_gradients_of_a_step_are_the_same(device: torch.device) -> None:
    gradients = []
    for place in (torch.device("cpu"), device):
        scene, start, command = many_random_transitions(10, seed=6)
        command = command.to(place).requires_grad_()
        given = (moved(each, place) for each in (scene, start))
        found = simulate_step(*given, command, STIFFNESS.to(place), COULOMB, engine="torch")
        (gradient,) = torch.autograd.grad(found.pose.sum(), command)
        gradients.append(gradient.cpu())
    same(gradients[1], gradients[0], 1e-6, allowed=1)


def test_rollouts_are_the_same(device: torch.device) -> None:
    scene, start, command = many_random_transitions(20, seed=7)
    share = torch.linspace(0.2, 1.0, 5, dtype=torch.float64)[:, None, None]
    commands = start + share * (command - start)
    on_cpu = rollout(scene, start, commands, STIFFNESS, COULOMB)
    given = (moved(each, device) for each in (scene, start, commands, STIFFNESS))
    on_device = rollout(*given, COULOMB, engine="torch")
    same(on_device[-1].pose, on_cpu[-1].pose, 1e-6, allowed=2)


def test_the_paper_s_filter_weighs_the_same(device: torch.device) -> None:
    shape = load_prior("ycb21-z2")
    poses, found = [], []
    settings = StepSettings("anitescu", substeps=1)
    for place, engine in ((torch.device("cpu"), "auto"), (device, "torch")):
        work = make_work(shape, 500, 5, 0, place)
        scene = column_scene(decoded_scene(shape, work.parameters))
        given = (scene, work.start, work.command, work.stiffness, settings)
        transition = simulate_step(*given, engine=engine)
        poses.append(transition.pose.cpu())
        found.append(weights(work, transition).cpu())
    # Outlines are decoded in float32, and few particles have most of the weight.
    same(poses[1], poses[0], 1e-5, allowed=2)
    assert float((found[1] - found[0]).abs().sum()) < 1e-3


def test_the_likelihood_of_a_history_is_the_same(device: torch.device) -> None:
    outline = builtin_outlines()["mug"]
    shape = PolygonShape(outline)
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", outline.vertices, generator)
    motion = make_motion("rich", scene, 6, generator)
    episode = record(make_truth(scene, "quasistatic"), scene, motion, 6, generator).measured
    prior = make_prior(shape)
    vectors = prior.to_vector(prior.sample(40, torch.Generator().manual_seed(2)))
    sd, history = torch.full((40,), 1e-3, dtype=torch.float64), history_of(episode)
    field, settings = MisfitField(1e-3, grain=0.2, roughness=15.0), StepSettings()
    placed = scene_from_parameters(shape, Parameters.from_vector(vectors))
    given = (placed.points_ee, history.setting(placed), sd)
    expected = compiled_filter(*given, field, settings)
    found = filter_history(*(moved(each, device) for each in given), field, settings)
    # Poses of settled steps that are 3e-8 m apart make 2e-5 of it.
    same(found.total, expected.total, 1e-4)
    assert torch.isfinite(expected.total).all()
    same(found.field_mean, expected.field_mean, 1e-7)
    same(found.field_covariance, expected.field_covariance, 1e-10)


def test_gains_are_the_same(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(4, 50, 3, generator=generator, dtype=torch.float64)
    factor = torch.eye(3, dtype=torch.float64).expand(4, 50, 3, 3) * vector(0.3, 0.4, 0.5)
    even = torch.full((4, 50), 0.02, dtype=torch.float64)
    field = 0.2 * torch.randn(4, 50, 3, 6, generator=generator, dtype=torch.float64)
    outcomes = Outcomes(
        mean, torch.linalg.cholesky(factor @ factor.mT + field @ field.mT), even, field
    )
    after = outcomes.after(outcomes, 1, mean[1, 2])
    values, answers = mean[0], field[0]
    elsewhere = moved(outcomes, device)
    for here, there in (
        (outcomes, elsewhere),
        (after, elsewhere.after(elsewhere, 1, mean[1, 2].to(device))),
    ):
        same(expected_information_gain(there), expected_information_gain(here), 1e-10)
        found = expected_variance(there, values.to(device), answers.to(device))
        same(found, expected_variance(here, values, answers), 1e-10)
