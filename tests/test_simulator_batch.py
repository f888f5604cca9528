"""The step over a batch: shapes, isolation, what elements report."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from contact_scenes import (
    STIFFNESS,
    make_scene,
    many_random_transitions,
    outline_points,
    random_transitions,
    scene_floor,
    scene_wall,
    vector,
)

from tpcd.contact import ContactScene, terrain_gaps
from tpcd.planar import transform_points
from tpcd.simulator import StepSettings, StepStatus, simulate_step

ANSWERS = ("pose", "wrench", "mode", "status", "pose_from_start", "pose_from_gap")


def turns_in_contact(settings):
    """Turns of 0.24 rad from rest in contact, and the same in one part."""
    scene, start, first = many_random_transitions(40, seed=64)
    rest = simulate_step(scene, start, first, STIFFNESS)
    turned = first + vector(0, 0, 0.24) * -first[:, 2:].sign()
    given = (scene, rest.pose, turned, STIFFNESS)
    whole = simulate_step(*given, replace(settings, substeps=1), previous=first)
    return simulate_step(*given, settings, previous=first), whole


def test_where_the_parts_end_worse_the_whole_is_the_answer():
    """With so few rounds many parts do not settle."""
    found, whole = turns_in_contact(StepSettings(rounds=3))
    assert (found.status <= whole.status).all()
    parted = (found.pose != whole.pose).any(-1)
    worse = ~parted & (whole.status == StepStatus.CONVERGED)
    assert float(worse.double().mean()) > 0.02 and float(parted.double().mean()) > 0.3
    for name in ANSWERS:
        torch.testing.assert_close(getattr(found, name)[worse], getattr(whole, name)[worse])


def test_resting_under_the_same_command_moves_nothing():
    scene, start, command = many_random_transitions(20, seed=63)
    rest = simulate_step(scene, start, command, STIFFNESS, StepSettings(substeps=1))
    again = simulate_step(scene, rest.pose, command, STIFFNESS, StepSettings(substeps=1))
    converged = (rest.status == StepStatus.CONVERGED) & (again.status == StepStatus.CONVERGED)
    moved = (again.pose - rest.pose).abs().amax(-1)
    assert float((moved < 1e-5)[converged].double().mean()) > 0.99


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (1,), (0,), (2, 0)])
def test_answers_have_the_shape_of_the_batch(shape):
    scene = make_scene(friction=torch.full(shape, 0.4))
    start = vector(0, 0.06, 0).expand(*shape, 3)
    result = simulate_step(scene, start, start, STIFFNESS)
    assert result.pose.shape == (*shape, 3) and result.wrench.shape == (*shape, 3)
    assert result.mode.shape == (*shape, 2) and result.status.shape == shape
    assert result.residual.shape == shape
    assert result.pose_from_start.shape == (*shape, 3, 3)
    assert result.pose_from_gap.shape == (*shape, 2, 3) == result.pose_from_lever.shape


def test_scenes_and_transitions_broadcast():
    scene, start, command = random_transitions(outline_points("mug"), 4, seed=64)
    column = make_scene(
        scene.points_ee[:, None],
        scene.friction[:, :1],
        scene_floor(scene)[:, None],
        scene_wall(scene)[:, None],
    )
    grid = simulate_step(column, start[:3], command[:3], STIFFNESS)
    assert grid.pose.shape == (4, 3, 3)
    for i in range(4):
        for j in range(3):
            one = simulate_step(scene.gather(torch.tensor([i])), start[j], command[j], STIFFNESS)
            torch.testing.assert_close(grid.pose[i, j], one.pose[0], atol=1e-12, rtol=0)


def test_inputs_in_float32_are_solved_in_float64():
    scene = make_scene()
    narrow = ContactScene(
        scene.points_ee.float(),
        tuple(type(b)(b.direction.float(), b.offset.float()) for b in scene.terrains),
        scene.friction.float(),
    )
    result = simulate_step(
        narrow, vector(0, 0.06, 0).float(), vector(0, 0.02, 0).float(), STIFFNESS
    )
    assert result.pose.dtype == torch.float64
    assert abs(float(result.pose[1]) - 0.05) < 1e-8


def broken_batch(what: str):
    """Five transitions of which the middle one is broken."""
    scene, start, command = random_transitions(outline_points("hex_nut"), 5, seed=65)
    points, friction = scene.points_ee.clone(), scene.friction.clone()
    height, position = scene_floor(scene).clone(), scene_wall(scene).clone()
    if what == "point":
        points[2, 7, 0] = math.nan
    elif what == "infinite point":
        points[2, 7, 1] = math.inf
    elif what == "friction":
        friction[2] = math.nan
    elif what == "floor":
        height[2] = math.nan
    elif what == "wall":
        position[2] = math.inf
    elif what == "start":
        start[2, 2] = math.nan
    elif what == "command":
        command[2, 0] = math.inf
    elif what == "jam":
        friction[2] = 2.0
        lowest = transform_points(start[2] * vector(0, 0, 1), points[2])
        start[2, 0] = position[2] - lowest[:, 0].max() + 0.002
        start[2, 1] = height[2] - lowest[:, 1].min() - 0.002
    return make_scene(points, friction[:, 0], height, position), start, command


BROKEN = ["point", "infinite point", "friction", "floor", "wall", "start", "command", "jam"]


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_element_is_flagged_and_changes_no_other(what):
    sound = simulate_step(*broken_batch("nothing"), STIFFNESS)
    scene, *transition = broken_batch(what)
    result = simulate_step(scene, *transition, STIFFNESS)
    others = torch.tensor([0, 1, 3, 4])
    for name in ANSWERS:
        expected, found = getattr(sound, name)[others], getattr(result, name)[others]
        assert torch.equal(found, expected)
    if what == "jam":
        # Pushed out of both terrains, with friction, and told.
        assert int(result.status[2]) == StepStatus.START_INSIDE
        assert float(terrain_gaps(scene, result.pose)[2].min()) > -1e-7
    else:
        assert int(result.status[2]) == StepStatus.INVALID_INPUT
        assert torch.isnan(result.pose[2]).all() and torch.isnan(result.wrench[2]).all()
        assert math.isinf(float(result.residual[2])) and result.mode[2].tolist() == [0, 0]


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_element_leaves_the_gradients_of_the_others_alone(what):
    """Regression: its NaN once reached what all elements share."""
    gradients = []
    for kind in ("nothing", what):
        scene, start, command = broken_batch(kind)
        stiffness = STIFFNESS.clone().requires_grad_()
        shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        result = simulate_step(scene, start, command + shift, stiffness)
        good = result.pose[torch.tensor([0, 1, 3, 4])].sum()
        gradients.append(torch.cat(torch.autograd.grad(good, (stiffness, shift))))
    assert torch.isfinite(gradients[1]).all()
    torch.testing.assert_close(gradients[1], gradients[0], atol=1e-9, rtol=1e-9)


def test_running_out_of_rounds_is_a_status_with_a_residual():
    scene, start, command = many_random_transitions(10, seed=66)
    result = simulate_step(scene, start, command, STIFFNESS, StepSettings(rounds=1, substeps=1))
    short = result.status == StepStatus.NOT_CONVERGED
    assert short.any()
    assert (result.residual[short] > 1e-7).all()
    assert (result.residual[result.status == StepStatus.CONVERGED] <= 1e-7).all()
    assert torch.isfinite(result.pose).all()


def test_the_wrench_is_the_impedance_times_the_offset():
    scene, start, command = many_random_transitions(10, seed=67)
    result = simulate_step(scene, start, command, STIFFNESS)
    torch.testing.assert_close(
        result.wrench, STIFFNESS * (result.pose - command), atol=1e-10, rtol=0
    )
