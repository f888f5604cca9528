"""Terrains that yield: the contact law against independent answers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from contact_scenes import BOX, STIFFNESS, make_scene, many_random_transitions, vector
from scipy.optimize import minimize
from simulator_steps import step

from tpcd.contact import ContactScene, terrain_gaps
from tpcd.simulator import ContactMode, StepSettings, StepStatus, Transition, simulate_step
from tpcd.terrain import HalfPlane, floor, wall

ONCE = StepSettings(substeps=1)


def softened(scene: ContactScene, seed: int = 5, most: float = 1e-3) -> ContactScene:
    """The scenes on terrains that yield by up to so much [m/N], each by its own."""
    random = torch.Generator().manual_seed(seed)
    share = torch.rand(scene.friction.shape, generator=random, dtype=torch.float64)
    return replace(scene, compliance=most * share)


def lowest(scene: ContactScene, pose: torch.Tensor) -> torch.Tensor:
    gaps = terrain_gaps(scene, pose)
    return gaps.amin(-1)


def laws_broken(scene: ContactScene, result: Transition) -> torch.Tensor:
    """By how much steps end off the law of contact [N], whichever way they were found: balance of
    wrenches, springs of the terrains, and friction within its cone, and at its edge in a slip."""
    normal, drag = result.contacts[..., 0], result.contacts[..., 1]
    arm = result.contacts[..., 2:]
    outward = torch.stack([plane.direction for plane in scene.terrains], -2)
    along = torch.stack((outward[..., 1], -outward[..., 0]), dim=-1)
    force = normal[..., None] * outward + drag[..., None] * along
    torque = arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0]
    balance = torch.cat((force.sum(-2), torque.sum(-1, keepdim=True)), dim=-1) - result.wrench
    spring = normal + (lowest(scene, result.pose) / scene.compliance).clamp_max(0.0)
    cone = (drag.abs() - scene.friction * normal).clamp_min(0.0)
    slips = result.mode > int(ContactMode.STICK)
    edge = torch.where(slips, drag.abs() - scene.friction * normal, 0.0)
    return torch.cat((balance, spring, cone, edge), dim=-1).abs().amax(-1)


def test_where_a_step_ends_loads_springs_and_friction_obey_their_laws() -> None:
    """With 1 mm/N at most, 1e-7 m off a spring are 1e-4 N or, where it is stiff, more."""
    scene, start, command = many_random_transitions(100, seed=71)
    scene = softened(scene)
    result = simulate_step(scene, start, command, STIFFNESS, ONCE)
    settled = result.status == int(StepStatus.CONVERGED)
    assert float(settled.double().mean()) > 0.99
    both = (result.contacts[..., 0] > 0).all(-1) & settled
    assert int(both.sum()) > 200
    broken = laws_broken(scene, result)[settled]
    assert float((broken < 0.02).double().mean()) > 0.99 and float(broken.median()) < 1e-5


def test_without_friction_a_step_ends_where_a_general_solver_finds_the_least_energy() -> None:
    scene, start, command = many_random_transitions(3, seed=72)
    scene = softened(replace(scene, friction=torch.zeros_like(scene.friction)))
    result = simulate_step(scene, start, command, STIFFNESS, ONCE)
    pressed = torch.nonzero((result.contacts[..., 0] > 0.1).any(-1)).flatten()
    assert len(pressed) > 15
    for k in pressed.tolist():
        one, root = scene.gather(torch.tensor([k])), scene.compliance[k].sqrt()
        energy, room = partial(_energy, command[k]), partial(_room, one)
        best = minimize(
            energy,
            torch.cat((start[k], 0 * root)).numpy(),
            constraints={"type": "ineq", "fun": room},
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 300},
        )
        found = torch.cat((result.pose[k], root * result.contacts[k, :, 0])).numpy()
        assert energy(found) <= energy(best.x) + 1e-7
        assert room(found).min() > -1e-6


def _energy(command: torch.Tensor, variables: np.ndarray) -> float:
    """Of the arm's spring and of those of the terrains [J], by the pose and the roots of twice what
    the terrains take up."""
    pose, taken = torch.as_tensor(variables).split((3, 2))
    return float(0.5 * (STIFFNESS * (pose - command) ** 2).sum() + 0.5 * (taken**2).sum())


def _room(scene: ContactScene, variables: np.ndarray) -> np.ndarray:
    """Gaps of all points to terrains that have yielded [m]."""
    pose, taken = torch.as_tensor(variables).split((3, 2))
    gaps = terrain_gaps(scene, pose[None])
    return (gaps[0] + (scene.compliance[0].sqrt() * taken)[:, None]).flatten().numpy()


@pytest.mark.parametrize("soft", [(2e-4, 5e-4), (1e-3, 1e-5), (1e-6, 1e-4)])
def test_floor_and_wall_share_the_load_of_what_both_hold_by_their_springs(
    soft: tuple[float, float],
) -> None:
    """A ladder that stands fast on the floor, sinks with it, and so slips down the wall: a linear
    system of springs. On rigid ground it would not move, and its loads would be anybody's guess."""
    lean, mu = 0.9, 0.6
    reach, rise = 0.2 * math.cos(lean), 0.2 * math.sin(lean)
    scene = make_scene(vector([-0.2, 0.0], [0.2, 0.0]), mu, -rise, reach, vector(*soft))
    start, way = vector(0, 0, lean), vector(3e-4, -3e-4, -1e-4)
    result = step(scene, start, start + way, tolerance=1e-12)
    # How gaps and places along the surfaces move with the pose.
    normal = (vector(0, 1, -reach), vector(-1, 0, rise))
    along = (vector(1, 0, rise), vector(0, 1, reach))
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[:3, :3] = torch.diag(STIFFNESS) + torch.outer(normal[0], normal[0]) / soft[0]
    matrix[:3, :3] += torch.outer(normal[1] + mu * along[1], normal[1]) / soft[1]
    matrix[:3, 3], matrix[3, :3] = -along[0], along[0]
    solved = torch.linalg.solve(matrix, torch.cat((STIFFNESS * way, vector(0))))
    moved, drag = solved[:3], float(solved[3])
    load = torch.stack([-(row @ moved) / c for row, c in zip(normal, soft, strict=True)])
    # As the question supposes.
    assert (load > 0.01).all() and abs(drag) < mu * float(load[0]) and along[1] @ moved < -1e-6
    assert result.mode.tolist() == [ContactMode.STICK, ContactMode.SLIP_NEGATIVE]
    # To first order in a way of 0.3 mm and 0.1 mrad.
    torch.testing.assert_close(result.pose - start, moved, rtol=2e-3, atol=2e-8)
    torch.testing.assert_close(result.contacts[:, 0], load, rtol=2e-3, atol=0)
    torch.testing.assert_close(
        result.contacts[:, 1], torch.stack((solved[3], mu * load[1])), rtol=2e-3, atol=1e-5
    )


def test_a_rigid_scene_is_answered_the_same_beside_one_that_yields() -> None:
    scene, start, command = many_random_transitions(2, seed=73)
    some = torch.arange(len(start)) % 3 == 0
    soft = softened(scene)
    mixed = replace(soft, compliance=torch.where(some[:, None], soft.compliance, 0.0))
    whole = simulate_step(mixed, start, command, STIFFNESS)
    for each, those in ((scene, ~some), (soft, some)):
        alone = simulate_step(each, start, command, STIFFNESS)
        for name, value in vars(alone).items():
            assert torch.equal(getattr(whole, name)[those], value[those])


def test_terrain_that_hardly_yields_is_as_rigid_terrain() -> None:
    scene, start, command = many_random_transitions(8, seed=74)
    rigid = simulate_step(scene, start, command, STIFFNESS)
    soft = softened(scene, most=1e-8)
    nearly = simulate_step(soft, start, command, STIFFNESS)
    near = (rigid.pose - nearly.pose).abs().amax(-1) < 1e-6
    # Where both hold it the rigid law leaves some ends open.
    assert float(near.double().mean()) > 0.97


@pytest.mark.parametrize("wrong", [-1e-4, float("nan"), float("inf")])
def test_a_compliance_that_means_nothing_is_flagged_and_disturbs_no_other(wrong: float) -> None:
    scene, start, command = many_random_transitions(1, seed=75)
    soft = softened(scene)
    fine = simulate_step(soft, start, command, STIFFNESS)
    compliance = soft.compliance.clone()
    compliance[4, 1] = wrong
    bad = replace(soft, compliance=compliance)
    found = simulate_step(bad, start, command, STIFFNESS)
    assert int(found.status[4]) == StepStatus.INVALID_INPUT and found.pose[4].isnan().all()
    others = torch.arange(len(start)) != 4
    assert torch.equal(found.pose[others], fine.pose[others])


def test_what_jams_on_rigid_terrain_is_answered_beside_terrain_that_yields() -> None:
    """A box between a floor and two walls that are closer than it is wide: on rigid walls it jams
    even without friction, and is put between them."""
    two, zero = torch.zeros(2, dtype=torch.float64), vector(0.0, 0.0)
    walls = (wall(two + 0.02), HalfPlane(vector(1, 0).expand(2, 2), two - 0.02))
    compliance = torch.zeros(2, 3, dtype=torch.float64)
    compliance[1] = 1e-3
    scene = ContactScene(
        BOX.expand(2, -1, 2), (floor(zero), *walls), torch.full((2, 3), 0.5).double(), compliance
    )
    start, command = vector(0, 0.05, 0).expand(2, 3), vector(0, 0.04, 0).expand(2, 3)
    found = simulate_step(scene, start, command, STIFFNESS, ONCE)
    # It starts 10 mm inside both walls.
    assert found.status.tolist() == [StepStatus.RELAXED, StepStatus.START_INSIDE]
    torch.testing.assert_close(found.pose[0], vector(0, 0.05, 0), atol=1e-4, rtol=0)
