"""Symmetries of the step and of outlines."""

from __future__ import annotations

import pytest
import torch
from contact_scenes import (
    BOX,
    STIFFNESS,
    make_scene,
    outline_points,
    random_transitions,
    regular_polygon,
    scene_floor,
    scene_wall,
    vector,
)
from simulator_steps import FRICTIONS, SIDES, step

from tpcd.contact import ContactScene
from tpcd.planar import compose, rotate, transform_points
from tpcd.simulator import StepSettings, StepStatus, simulate_step
from tpcd.terrain import HalfPlane

# Symmetry


@FRICTIONS
@pytest.mark.parametrize("substeps", [1, 3])
def test_mirroring_everything_mirrors_the_answer(friction_law, substeps):
    scene, start, command = random_transitions(outline_points("mug"), 80, seed=11)
    mirror = vector(-1, 1, -1)
    left_wall = HalfPlane(vector(1, 0).expand(80, 2), -scene_wall(scene))
    flipped = ContactScene(
        scene.points_ee * vector(-1, 1), (scene.terrains[0], left_wall), scene.friction
    )
    settings = StepSettings(friction=friction_law, substeps=substeps, follow_path=True)
    result = simulate_step(scene, start, command, STIFFNESS, settings)
    other = simulate_step(flipped, start * mirror, command * mirror, STIFFNESS, settings)
    same = (result.pose - other.pose * mirror).abs().amax(-1) < 1e-7
    torch.testing.assert_close(result.wrench[same], other.wrench[same] * mirror, atol=1e-5, rtol=0)
    # Where Coulomb friction has several answers, the mirrored search may end in another.
    assert int((~same).sum()) <= (3 if friction_law == "coulomb" else 0)


def test_moving_the_world_along_moves_the_answer_along():
    scene, start, command = random_transitions(outline_points("banana"), 80, seed=12)
    shift = vector(0.7, -0.4, 0)
    moved = make_scene(
        scene.points_ee,
        scene.friction[:, 0],
        scene_floor(scene) + shift[1],
        scene_wall(scene) + shift[0],
    )
    result = step(scene, start, command, rounds=60)
    other = step(moved, start + shift, command + shift, rounds=60)
    torch.testing.assert_close(other.pose, result.pose + shift, atol=1e-7, rtol=0)
    torch.testing.assert_close(other.wrench, result.wrench, atol=1e-5, rtol=0)


def test_rotating_everything_rotates_the_wrench():
    """With equal stiffness in x and z the laws know no direction."""
    angle = 0.6
    scene, start, command = random_transitions(outline_points("hex_nut"), 80, seed=13)
    turn = vector(0, 0, angle)
    terrains = tuple(
        HalfPlane(rotate(turn[2], body.direction), body.offset) for body in scene.terrains
    )
    turned = ContactScene(scene.points_ee, terrains, scene.friction)
    settings = StepSettings(substeps=1, rounds=60)
    result = simulate_step(scene, start, command, STIFFNESS, settings)
    other = simulate_step(turned, compose(turn, start), compose(turn, command), STIFFNESS, settings)
    settled = (result.status == StepStatus.CONVERGED) & (other.status == StepStatus.CONVERGED)
    assert int((~settled).sum()) <= 2
    expected = compose(turn, result.pose)
    torch.testing.assert_close(other.pose[settled], expected[settled], atol=1e-7, rtol=0)
    forces = torch.cat((rotate(turn[2], result.wrench[:, :2]), result.wrench[:, 2:]), dim=-1)
    torch.testing.assert_close(other.wrench[settled], forces[settled], atol=1e-5, rtol=0)


# Geometry


@FRICTIONS
@SIDES
def test_a_tilted_box_pressed_down_settles_on_its_flat_face(friction_law, side):
    """The first linearisation knows one corner only; the answer must know the face."""
    start = vector(0, 0.06, 0.12 * side)
    command = vector(0, -0.02, 0.0)
    result = step(make_scene(), start, command, friction=friction_law, rounds=60)
    if friction_law == "coulomb":
        assert abs(float(result.pose[2])) < 1e-6
        assert abs(float(result.pose[1]) - 0.05) < 1e-6
    gaps = transform_points(result.pose, BOX)[:, 1]
    assert float(gaps.min()) > -1e-8


@FRICTIONS
@pytest.mark.parametrize("name", ["mug", "hammer", "c_clamp", "star"])
def test_an_outline_touches_half_planes_as_its_hull_does(friction_law, name):
    from scipy.spatial import ConvexHull

    if name == "star":
        spikes = regular_polygon(10, 0.05)
        points = torch.where(torch.arange(10)[:, None] % 2 == 0, spikes, 0.4 * spikes)
    else:
        points = outline_points(name)
    hull = points[torch.from_numpy(ConvexHull(points.numpy()).vertices.astype("int64"))]
    assert len(hull) < len(points)
    scene, start, command = random_transitions(points, 60, seed=21)
    hull_scene, _, _ = random_transitions(hull, 60, seed=21)
    settings = StepSettings(friction=friction_law, substeps=1)
    result = simulate_step(scene, start, command, STIFFNESS, settings)
    other = simulate_step(hull_scene, start, command, STIFFNESS, settings)
    torch.testing.assert_close(result.pose, other.pose, atol=1e-8, rtol=0)


@FRICTIONS
def test_more_points_on_the_same_outline_change_nothing(friction_law):
    start, command = vector(-0.02, 0.07, 0.05), vector(0.04, 0.02, -0.08)
    edges = BOX.roll(-1, 0) - BOX
    fractions = torch.arange(16, dtype=torch.float64)[:, None, None] / 16
    dense = (BOX + fractions * edges).transpose(0, 1).reshape(-1, 2)
    few = step(make_scene(), start, command, friction=friction_law)
    many = step(make_scene(dense), start, command, friction=friction_law)
    shuffled = dense[torch.randperm(len(dense), generator=torch.Generator().manual_seed(0))]
    mixed = step(make_scene(shuffled), start, command, friction=friction_law)
    for other in (many, mixed):
        torch.testing.assert_close(other.pose, few.pose, atol=1e-8, rtol=0)
        torch.testing.assert_close(other.wrench, few.wrench, atol=1e-6, rtol=0)


@FRICTIONS
def test_no_point_of_the_outline_is_left_in_a_terrain(friction_law):
    for k, name in enumerate(("mug", "beer_bottle", "hex_nut", "egg")):
        scene, start, command = random_transitions(outline_points(name), 100, seed=30 + k)
        settings = StepSettings(friction=friction_law, substeps=1)
        result = simulate_step(scene, start, command, STIFFNESS, settings)
        world = transform_points(result.pose, scene.points_ee)
        gaps = torch.stack(
            (
                world[..., 1].amin(-1) - scene_floor(scene),
                scene_wall(scene) - world[..., 0].amax(-1),
            )
        )
        assert float(gaps[:, result.status == StepStatus.CONVERGED].min()) > -1e-6
