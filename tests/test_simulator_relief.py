"""Terrain that is not plane: laws of rest, paths, gradients, against independent answers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from contact_scenes import BOX, STIFFNESS, make_scene, many_random_transitions, vector
from scipy.optimize import minimize
from torch import Tensor

from tpcd.contact import ContactScene, terrain_gaps
from tpcd.simulator import StepSettings, StepStatus, rollout, simulate_step
from tpcd.terrain import HalfPlane, Relief, floor

ONCE = StepSettings(substeps=1)


def wave(height: float = 2e-3, length: float = 0.06) -> Relief:
    return Relief.of(lambda x: height * torch.sin(2 * math.pi * x / length), -0.6, 0.6)


def with_relief(scene: ContactScene, relief: Relief, *terrains: int) -> ContactScene:
    bodies = [
        replace(body, relief=relief) if t in terrains else body
        for t, body in enumerate(scene.terrains)
    ]
    return replace(scene, terrains=tuple(bodies))


def test_a_relief_is_the_function_that_it_was_made_of():
    relief, places = wave(), torch.linspace(-0.5, 0.5, 501, dtype=torch.float64)
    rise, slope = relief(places)
    number = 2 * math.pi / 0.06
    torch.testing.assert_close(rise, 2e-3 * (number * places).sin(), atol=1e-10, rtol=0)
    torch.testing.assert_close(slope, 2e-3 * number * (number * places).cos(), atol=1e-6, rtol=0)
    beyond = relief(torch.tensor([-5.0, 5.0], dtype=torch.float64))
    torch.testing.assert_close(beyond[0], relief.rise[[0, -1]])
    assert not beyond[1].any()


def test_a_relief_of_no_height_changes_nothing():
    scene, start, command = many_random_transitions(20, seed=91)
    flat = with_relief(scene, Relief.of(lambda x: 0.0 * x, -0.1, 0.1), 0, 1)
    found, expected = (
        simulate_step(each, start, command, STIFFNESS, ONCE) for each in (flat, scene)
    )
    torch.testing.assert_close(found.pose, expected.pose, atol=1e-7, rtol=0)
    assert torch.equal(found.mode, expected.mode) and torch.equal(found.status, expected.status)
    for name in ("pose_from_start", "pose_from_gap", "pose_from_lever"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-5
        )


@pytest.mark.parametrize("settings", [ONCE, StepSettings()], ids=["once", "path"])
def test_what_is_converged_obeys_the_laws_of_contact(settings: StepSettings):
    """Nothing is inside, what bears load is on the surface, forces lie in the cone of the local
    normal, and the arm's wrench is their sum."""
    scene, start, command = many_random_transitions(20, seed=92)
    scene = with_relief(scene, wave(), 0, 1)
    found = simulate_step(scene, start, command, STIFFNESS, settings)
    good = found.status <= StepStatus.START_INSIDE
    assert float(good.double().mean()) > 0.97
    assert bool((found.residual[found.status == StepStatus.NOT_CONVERGED] > 1e-7).all())
    gaps = terrain_gaps(scene, found.pose).amin(-1)[good]
    load, drag = found.contacts[good, :, 0], found.contacts[good, :, 1]
    assert float(gaps.min()) > -1e-6 and float(gaps[load > 0].abs().max()) < 1e-6
    assert int((load > 0).sum()) > 150
    assert bool((drag.abs() <= scene.friction[good] * load * (1 + 1e-9)).all())
    # With one contact point on each terrain the forces follow from its place.
    force = torch.zeros_like(found.pose[good, :2])
    for t, body in enumerate(scene.terrains):
        place = found.pose[good, :2] + found.contacts[good, t, 2:]
        normal = body.direction[good]
        tangent = torch.stack((normal[:, 1], -normal[:, 0]), dim=-1)
        _, slope = body.relief((place * tangent).sum(-1))
        size = (1 + slope**2).sqrt()[:, None]
        local = (normal - slope[:, None] * tangent) / size
        across = torch.stack((local[:, 1], -local[:, 0]), dim=-1)
        force += load[:, t, None] * local + drag[:, t, None] * across
    off = (found.wrench[good, :2] - force).norm(dim=-1)
    # Two points on one terrain have two normals.
    assert float((off < 1e-3).double().mean()) > 0.8


def test_without_friction_a_step_ends_where_a_general_solver_finds_the_least_energy():
    scene, start, command = many_random_transitions(3, seed=93)
    scene = with_relief(replace(scene, friction=torch.zeros_like(scene.friction)), wave(), 0)
    found = simulate_step(scene, start, command, STIFFNESS, ONCE)
    root = STIFFNESS.sqrt().numpy()
    compared = 0
    for k in range(len(start)):
        one = scene.gather(torch.tensor([k]))
        if int(found.status[k]) != StepStatus.CONVERGED or not bool(found.mode[k].any()):
            continue

        def gaps(pose: np.ndarray, one: ContactScene = one) -> np.ndarray:
            return terrain_gaps(one, torch.from_numpy(pose)[None])[0].flatten().numpy()

        def energy(pose: np.ndarray, k: int = k) -> float:
            return 0.5 * float(((root * (pose - command[k].numpy())) ** 2).sum())

        ended = found.pose[k].numpy()
        # From the answer itself: it is a local minimum if nothing near is better.
        better = minimize(
            energy, ended, method="SLSQP", constraints={"type": "ineq", "fun": gaps},
            options={"ftol": 1e-14, "maxiter": 200},
        )  # fmt: skip
        assert np.abs(better.x - ended).max() < 2e-5
        compared += 1
    assert compared > 15


def test_gradients_are_differences_away_from_changes_of_contact():
    scene, start, command = many_random_transitions(10, seed=94)
    scene = with_relief(scene, wave(), 0)
    settings = StepSettings(substeps=1, tolerance=1e-11)
    points = scene.points_ee.clone().requires_grad_()
    given = (start.clone().requires_grad_(), command.clone().requires_grad_())
    found = simulate_step(replace(scene, points_ee=points), *given, STIFFNESS, settings)
    good = found.status <= StepStatus.START_INSIDE
    by_start, by_command, by_points = torch.autograd.grad(found.pose[:, 1].sum(), (*given, points))

    def height(points: Tensor, start: Tensor, command: Tensor) -> Tensor:
        moved = replace(scene, points_ee=points)
        return simulate_step(moved, start, command, STIFFNESS, settings).pose[:, 1]

    size, right = 1e-6, []
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor(axis), size)
        right.append((by_start[:, axis], [(points, start + s * step, command) for s in (1, -1)]))
        right.append((by_command[:, axis], [(points, start, command + s * step) for s in (1, -1)]))
    # All points of an outline alike: the nearest of many may change.
    way = torch.randn(len(start), 1, 2, generator=torch.Generator().manual_seed(1)).double()
    ends = [(points + s * size * way, start, command) for s in (1, -1)]
    right.append(((by_points * way).sum((-1, -2)), ends))
    for slope, ends in right:
        up, down = (height(*(value.detach() for value in end)) for end in ends)
        difference = (up - down) / (2 * size)
        near = (slope - difference).abs() < 1e-4 * (1 + difference.abs())
        assert float(near[good].double().mean()) > 0.97


def test_a_bump_on_the_way_is_met_and_holds_the_object_back():
    """It is 20 mm high and lies between both ends of the way, at which a box is free 5 mm over the
    floor. So steep a foot is not settled to the end, which is told."""
    bump = Relief.of(lambda x: 0.02 * torch.exp(-0.5 * ((x - 0.1) / 4e-3) ** 2), 0.0, 0.2)
    scene = with_relief(make_scene(BOX, friction=0.3, position=9.0), bump, 0)
    start, command = vector(-0.05, 0.055, 0), vector(0.2, 0.055, 0)
    found = simulate_step(scene, start, command, STIFFNESS)
    assert int(found.mode[0]) and 0.05 < float(found.pose[0]) < 0.1
    assert int(found.status) == StepStatus.NOT_CONVERGED and float(found.residual) > 1e-7
    share = torch.linspace(0, 1, 251, dtype=torch.float64)[1:, None]
    slow = rollout(scene, start, start + share * (command - start), STIFFNESS, ONCE)[-1]
    torch.testing.assert_close(found.pose, slow.pose, atol=3e-3, rtol=0)


def test_what_a_relief_cannot_do_is_refused():
    scene = with_relief(make_scene(), wave(), 0)
    given = (vector(0, 0.06, 0), vector(0, 0.02, 0), STIFFNESS)
    with pytest.raises(ValueError, match="convex friction knows planes only"):
        simulate_step(scene, *given, StepSettings(friction="anitescu"))
    body = scene.terrains[0]
    leaning = replace(body, direction=body.direction.clone().requires_grad_())
    with pytest.raises(ValueError, match="no derivative by its direction"):
        simulate_step(replace(scene, terrains=(leaning, scene.terrains[1])), *given)
    with pytest.raises(ValueError, match="rise of a relief holds a NaN"):
        Relief(torch.tensor([0.0, math.nan]), torch.zeros(2), 0, 0.1)
    with pytest.raises(ValueError, match="pitch is 0"):
        Relief(torch.zeros(2), torch.zeros(2), 0, 0.0)
    assert isinstance(floor(vector(0.0)[0]), HalfPlane)
