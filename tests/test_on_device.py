"""The same answers of tensors on an accelerator as of those on the CPU: `make test-device`."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from contact_scenes import STIFFNESS, many_random_transitions, vector
from torch import Tensor

from eval.bench.contact_problems import random_contact_problems
from tpcd.information import Outcomes, expected_information_gain, expected_variance
from tpcd.qp import Status, solve
from tpcd.shape.checkpoint import load_prior
from tpcd.simulator import StepSettings, rollout, simulate_step

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
    on_cpu, on_device = solve(problem), solve(moved(problem, device))
    assert on_device.motion.device.type == device.type
    assert bool((on_device.status == int(Status.SOLVED)).all())
    same(on_device.motion, on_cpu.motion, 1e-12)
    same(on_device.multipliers, on_cpu.multipliers, 1e-8)
    gradients = []
    for place in (torch.device("cpu"), device):
        target = problem.target.detach().to(place).requires_grad_()
        answer = solve(replace(moved(problem, place), target=target))
        (gradient,) = torch.autograd.grad(answer.motion.square().sum(), target)
        gradients.append(gradient.cpu())
    same(gradients[1], gradients[0], 1e-9)


def test_one_bad_problem_changes_no_other(device: torch.device) -> None:
    problem = random_contact_problems(50, 16, seed=4)
    spoilt = problem.target.clone()
    spoilt[7] = torch.nan
    bad = replace(moved(problem, device), target=spoilt.to(device))
    expected, found = solve(problem), solve(bad)
    assert int(found.status[7]) != int(Status.SOLVED)
    others = torch.arange(50) != 7
    same(found.motion.cpu()[others], expected.motion[others], 1e-12)


@pytest.mark.parametrize("settings", [StepSettings(friction="anitescu", substeps=1), COULOMB])
def test_transitions_end_at_the_same_poses(settings: StepSettings, device: torch.device) -> None:
    scene, start, command = many_random_transitions(100, seed=5)
    on_cpu = simulate_step(scene, start, command, STIFFNESS, settings)
    given = (moved(each, device) for each in (scene, start, command, STIFFNESS))
    on_device = simulate_step(*given, settings)
    same(on_device.pose, on_cpu.pose, 0.0)
    same(on_device.wrench, on_cpu.wrench, 0.0)
    same(on_device.status, on_cpu.status, 0.0)


def test_gradients_of_a_step_are_the_same(device: torch.device) -> None:
    gradients = []
    for place in (torch.device("cpu"), device):
        scene, start, command = many_random_transitions(10, seed=6)
        command = command.to(place).requires_grad_()
        given = (moved(each, place) for each in (scene, start))
        found = simulate_step(*given, command, STIFFNESS.to(place), COULOMB)
        (gradient,) = torch.autograd.grad(found.pose.sum(), command)
        gradients.append(gradient.cpu())
    same(gradients[1], gradients[0], 1e-12)


def test_rollouts_are_the_same(device: torch.device) -> None:
    scene, start, command = many_random_transitions(20, seed=7)
    share = torch.linspace(0.2, 1.0, 5, dtype=torch.float64)[:, None, None]
    commands = start + share * (command - start)
    on_cpu = rollout(scene, start, commands, STIFFNESS, COULOMB)
    given = (moved(each, device) for each in (scene, start, commands, STIFFNESS))
    on_device = rollout(*given, COULOMB)
    same(on_device[-1].pose, on_cpu[-1].pose, 0.0)


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
