"""Closed forms of contacts with floor and wall."""

from __future__ import annotations

import math

import pytest
import torch
from contact_scenes import (
    BOX,
    SLAB,
    STIFFNESS,
    make_scene,
    outline_points,
    random_transitions,
    rotated,
    scene_floor,
    scene_wall,
    vector,
)
from simulator_steps import CLOSE, FRICTIONS, SIDES, assert_near, step

from tpcd.contact import ContactScene
from tpcd.planar import rotate, transform_points
from tpcd.simulator import ContactMode, StepSettings, StepStatus, simulate_step
from tpcd.terrain import HalfPlane, floor, wall

# One contact


@FRICTIONS
def test_a_box_pressed_on_the_floor_feels_stiffness_times_depth(friction_law):
    scene = make_scene(height=0.01)
    result = step(scene, vector(0, 0.1, 0), vector(0, 0.02, 0), friction=friction_law)
    assert_near(result.pose, 0, 0.06, 0)
    assert_near(result.wrench, 0, 4.0, 0, atol=1e-7)
    assert result.mode.tolist() == [ContactMode.STICK, ContactMode.FREE]


@FRICTIONS
def test_a_box_pressed_on_the_wall_feels_stiffness_times_depth(friction_law):
    scene = make_scene(position=0.1)
    result = step(scene, vector(0, 0.1, 0), vector(0.09, 0.1, 0), friction=friction_law)
    assert_near(result.pose, 0.07, 0.1, 0)
    assert_near(result.wrench, -2.0, 0, 0, atol=1e-7)
    assert result.mode.tolist() == [ContactMode.FREE, ContactMode.STICK]


@SIDES
@pytest.mark.parametrize("mu", [0.1, 0.4, 0.9])
def test_a_sliding_slab_feels_friction_times_the_normal_force_against_its_motion(mu, side):
    scene = make_scene(SLAB, friction=mu)
    result = step(scene, vector(0, 0.02, 0), vector(0.06 * side, -0.03, 0))
    assert_near(result.wrench, -side * mu * 5.0, 5.0, 0, atol=1e-7)
    assert_near(result.pose, side * (0.06 - mu * 5.0 / 100), 0.02, 0)
    slip = ContactMode.SLIP_POSITIVE if side > 0 else ContactMode.SLIP_NEGATIVE
    assert result.mode.tolist() == [slip, ContactMode.FREE]


@SIDES
def test_along_the_wall_friction_opposes_the_slip_too(side):
    scene = make_scene(SLAB.flip(-1).flip(0), friction=0.3, position=0.02)
    result = step(scene, vector(0, 0.5, 0), vector(0.04, 0.5 + 0.05 * side, 0))
    assert_near(result.wrench, -4.0, -side * 0.3 * 4.0, 0, atol=1e-7)
    slip = ContactMode.SLIP_POSITIVE if side > 0 else ContactMode.SLIP_NEGATIVE
    assert result.mode.tolist() == [ContactMode.FREE, slip]


@FRICTIONS
@SIDES
def test_a_command_within_the_friction_cone_moves_nothing(friction_law, side):
    command = vector(0.015 * side, 0, 0)
    result = step(make_scene(), vector(0, 0.05, 0), command, friction=friction_law)
    # The tangential force at the foot turns the box only where its torque tips it.
    assert_near(result.pose, 0, 0.05, 0)
    assert_near(result.wrench, -1.5 * side, 5.0, 0, atol=1e-7)
    assert int(result.mode[0]) == ContactMode.STICK


def test_without_friction_the_tangential_force_vanishes():
    scene = make_scene(SLAB, friction=0.0)
    result = step(scene, vector(0, 0.02, 0), vector(0.05, -0.01, 0))
    assert_near(result.pose, 0.05, 0.02, 0)
    assert_near(result.wrench, 0, 3.0, 0, atol=1e-7)


@FRICTIONS
def test_a_point_contact_gives_the_torque_of_its_lever(friction_law):
    wedge = vector([0.04, -0.05], [0.05, 0.05], [-0.05, 0.05])
    scene = make_scene(wedge, friction=0.5)
    result = step(scene, vector(0, 0.06, 0), vector(0, 0.01, 0), friction=friction_law)
    arm = rotate(result.pose[2], wedge[0])
    force = result.wrench[:2]
    assert abs(float(result.pose[1] + arm[1])) < CLOSE
    torque = arm[0] * force[1] - arm[1] * force[0]
    assert abs(float(result.wrench[2] - torque)) < 1e-7
    assert float(result.wrench[2]) > 0.05


@SIDES
def test_a_torque_beyond_half_the_width_times_the_load_tips_the_box(side):
    load, width = 4.0, 0.03
    flat = step(
        make_scene(friction=0.0),
        vector(0, 0.05, 0),
        vector(0, 0.05 - load / 100, side * 0.99 * load * width / 50),
    )
    assert_near(flat.pose, 0, 0.05, 0)
    tipped = step(
        make_scene(friction=0.0),
        vector(0, 0.05, 0),
        vector(0, 0.05 - load / 100, side * 2.0 * load * width / 50),
    )
    assert side * float(tipped.pose[2]) > 1e-3
    corner = transform_points(tipped.pose, BOX)
    assert abs(float(corner[:, 1].min())) < CLOSE


# Floor and wall


def test_in_the_corner_each_terrain_bears_its_own_axis():
    scene = make_scene(friction=0.0, position=0.05)
    result = step(scene, vector(0, 0.06, 0), vector(0.05, 0.02, 0))
    assert_near(result.pose, 0.02, 0.05, 0)
    assert_near(result.wrench, -3.0, 3.0, 0, atol=1e-7)
    assert ContactMode.FREE not in result.mode.tolist()


@pytest.mark.parametrize("mu", [1.2, 1.5])
def test_a_box_jammed_between_floor_and_wall_is_answered_without_friction(mu):
    scene = make_scene(friction=mu, position=0.025)
    arguments = (vector(0, 0.045, 0), vector(0.01, 0.02, 0), STIFFNESS, StepSettings())
    result = simulate_step(scene, *arguments)
    free = simulate_step(make_scene(friction=0.0, position=0.025), *arguments)
    assert int(result.status) == StepStatus.RELAXED
    torch.testing.assert_close(result.pose, free.pose, atol=1e-8, rtol=0)
    assert_near(result.pose, -0.005, 0.05, 0, atol=1e-8)


@SIDES
@pytest.mark.parametrize("mu", [0.6, 1.2, 2.0])
def test_a_disc_that_is_turned_in_a_corner_slips_on_both_terrains(mu, side):
    """However rough they are: the law would also let it hold, by forces of thousands of newtons
    between floor and wall that nothing presses it with. Closed form of Coulomb friction."""
    radius, turn = 0.04, 0.12
    angle = torch.arange(720, dtype=torch.float64) * math.pi / 360
    disc = radius * torch.stack((angle.cos(), angle.sin()), dim=-1)
    scene = ContactScene(
        disc, (floor(vector(0.0)[0]), wall(vector(0.1)[0])), torch.full_like(vector(0, 0), mu)
    )
    start = vector(0.1 - radius, radius, 0)
    # The arm presses with 5 N on the terrain that friction draws the disc away from.
    right, down = (5.0, 1.0) if side > 0 else (1.0, 5.0)
    command = start + vector(right / 100, -down / 100, side * turn)
    result = step(scene, start, command)
    on_floor = (down + side * mu * right) / (1 + mu**2)
    on_wall = (right - side * mu * down) / (1 + mu**2)
    torque = mu * radius * (on_floor + on_wall)
    loads = result.contacts[..., 0]
    torch.testing.assert_close(loads, vector(on_floor, on_wall), atol=1e-3, rtol=0)
    assert_near(result.pose[:2], 0.1 - radius, radius, atol=1e-6)
    assert_near(result.pose[2:], side * (turn - torque / 50), atol=1e-4)


def test_a_corridor_too_low_for_the_object_is_answered_near_it_and_flagged():
    """Regression: floor and ceiling closer than the box once recursed without end."""
    one = torch.ones((), dtype=torch.float64)
    scene = ContactScene(
        BOX, (floor(0 * one), HalfPlane(vector(0, -1), -0.09 * one)), vector(0.4, 0.4)
    )
    result = simulate_step(
        scene, vector(0, 0.045, 0), vector(0, 0.02, 0), STIFFNESS, StepSettings()
    )
    assert int(result.status) == StepStatus.RELAXED
    assert torch.isfinite(result.wrench).all()
    # Turning does not help, so it yields to both sides and stays within the overlap.
    world = transform_points(result.pose, BOX)[:, 1]
    assert float(world.min()) > -0.011 and float(world.max()) < 0.101


@FRICTIONS
def test_jammed_answers_are_finite_near_and_without_friction(friction_law):
    points = outline_points("mug")
    scene, start, command = random_transitions(points, 60, seed=3)
    inside = torch.stack((scene_wall(scene), scene_floor(scene), 0 * start[:, 2]), dim=-1)
    lowest = transform_points(start * vector(0, 0, 1), scene.points_ee)
    start = torch.cat(
        (
            (inside[:, 0] - lowest[..., 0].amax(-1) + 0.002)[:, None],
            (inside[:, 1] - lowest[..., 1].amin(-1) - 0.002)[:, None],
            start[:, 2:],
        ),
        dim=-1,
    )
    scene = ContactScene(scene.points_ee, scene.terrains, torch.full_like(scene.friction, 2.0))
    result = simulate_step(
        scene, start, command, STIFFNESS, StepSettings(friction=friction_law, substeps=1)
    )
    relaxed = result.status == StepStatus.RELAXED
    assert int(relaxed.sum()) > 10
    free = simulate_step(
        ContactScene(scene.points_ee, scene.terrains, 0 * scene.friction),
        start,
        command,
        STIFFNESS,
        StepSettings(friction=friction_law, substeps=1),
    )
    torch.testing.assert_close(result.pose[relaxed], free.pose[relaxed], atol=1e-7, rtol=0)
    assert float((result.pose - start)[relaxed, :2].abs().max()) < 0.1


def test_a_wall_on_a_slope_holds_the_box_at_its_normal():
    """Terrains are any half-planes: here a floor that leans by 0.2 rad."""
    normal = vector(-math.sin(0.2), math.cos(0.2))
    scene = ContactScene(
        rotated(SLAB, 0.2),
        (HalfPlane(normal, vector(0.0)[0]), wall(vector(9.0)[0])),
        vector(0.0, 0.0),
    )
    start = torch.cat((0.02 * normal, vector(0)))
    command = torch.cat((-0.02 * normal, vector(0)))
    result = step(scene, start, command)
    torch.testing.assert_close(result.wrench[:2], 4.0 * normal, atol=1e-7, rtol=0)
