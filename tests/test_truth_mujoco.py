"""The independent truth against closed forms, symmetries and its own time step."""

from __future__ import annotations

import builtins
import math

import numpy as np
import pytest
import torch

from tpcd.errors import SolverError
from tpcd.truth.hull import hull_vertices
from tpcd.truth.mujoco_scene import MujocoSettings
from tpcd.truth.mujoco_truth import MujocoTruth

FORCE_TOLERANCE = 5e-3
"""Closed forms hold to this [N]; torques to the same number [N·m]."""


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


STIFFNESS = vector(100.0, 100.0, 50.0)
BOX = torch.tensor([[-0.03, -0.05], [0.03, -0.05], [0.03, 0.05], [-0.03, 0.05]]).double()

SLAB = BOX.flip(-1).flip(0)
"""The box lying on its side: too low to tip under its own friction."""


def make_truth(vertices=BOX, friction=0.4, floor=0.0, wall=0.1, stiffness=STIFFNESS, **settings):
    return MujocoTruth(vertices, friction, floor, wall, stiffness, MujocoSettings(**settings))


def follow(truth: MujocoTruth, start, *commands) -> list[np.ndarray]:
    """Rows (6,) of pose and wrench after each command; every step must settle."""
    truth.reset(vector(*start))
    rows = []
    for command in commands:
        pose, wrench, settled = truth.step(vector(*command))
        assert settled
        assert torch.allclose(wrench, truth.contact_wrench(), atol=FORCE_TOLERANCE)
        rows.append(torch.cat((pose, wrench)).numpy())
    return rows


def test_free_motion_reaches_the_command_without_force():
    (row,) = follow(make_truth(), (0, 0.1, 0), (0.02, 0.12, -0.3))
    assert np.allclose(row[:3], [0.02, 0.12, -0.3], atol=1e-5)
    assert np.abs(row[3:]).max() < 1e-3


def test_a_box_pressed_on_the_floor_feels_stiffness_times_depth_upwards():
    (row,) = follow(make_truth(floor=0.01), (0, 0.08, 0), (0, 0.02, 0))
    assert np.allclose(row, [0, 0.06, 0, 0, 4.0, 0], atol=FORCE_TOLERANCE)
    assert abs(row[1] - 0.06) < 1e-5


@pytest.mark.parametrize("friction", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("direction", [-1, 1])
def test_sliding_friction_is_friction_times_normal_force_against_the_motion(friction, direction):
    truth = make_truth(SLAB, friction=friction, wall=0.3)
    _, row = follow(truth, (0, 0.04, 0), (0, -0.02, 0), (0.06 * direction, -0.02, 0))
    assert np.allclose(row[3:5], [-direction * friction * 5.0, 5.0], atol=FORCE_TOLERANCE)
    assert abs(row[5]) < FORCE_TOLERANCE  # a flat face on the floor does not turn


def test_a_command_within_the_friction_cone_does_not_move_the_box():
    _, row = follow(make_truth(friction=0.4), (0, 0.06, 0), (0, 0, 0), (0.015, 0, 0))
    assert abs(row[0]) < 2e-5
    assert np.allclose(row[3:5], [-1.5, 5.0], atol=FORCE_TOLERANCE)


def test_pressing_on_a_corner_right_of_the_arm_turns_it_towards_z():
    """A single point at (a, b) of the object: torque = a' F_z - b' F_x about the origin."""
    wedge = torch.tensor([[0.04, -0.05], [0.05, 0.05], [-0.05, 0.05]]).double()
    (row,) = follow(make_truth(wedge, friction=0.5), (0, 0.06, 0), (0, 0.01, 0))
    cosine, sine = math.cos(row[2]), math.sin(row[2])
    corner = np.array([cosine * 0.04 + sine * 0.05, sine * 0.04 - cosine * 0.05])
    assert abs(row[1] + corner[1]) < 1e-5  # the corner is on the floor
    assert row[2] > 0 and row[5] > 0.1  # it turned counter-clockwise, pushed by the floor
    assert abs(row[5] - (corner[0] * row[4] - corner[1] * row[3])) < 1e-3


def test_a_box_in_the_corner_between_floor_and_wall_feels_both_depths():
    *_, row = follow(
        make_truth(friction=0.2), (0, 0.06, 0), (0.0, 0.06, 0), (0.11, 0.06, 0), (0.11, 0.02, 0)
    )
    # The wall holds x, friction 0.2 * 4 N on the wall carries part of the downward press.
    assert np.allclose(row[[0, 3]], [0.07, -4.0], atol=FORCE_TOLERANCE)
    assert abs(row[1] - 0.05) < 2e-5
    assert np.allclose(row[4], 3.0, atol=FORCE_TOLERANCE)


def test_sliding_down_the_wall_is_resisted_by_friction():
    *_, row = follow(
        make_truth(friction=0.3), (0, 0.15, 0), (0.10, 0.15, 0), (0.10, 0.10, 0)
    )  # fmt: skip
    assert np.allclose(row[3:5], [-3.0, 0.9], atol=FORCE_TOLERANCE)


def random_scene(seed: int) -> tuple[torch.Tensor, float, list[torch.Tensor]]:
    generator = np.random.default_rng(seed)
    angles = np.sort(generator.uniform(0, 2 * np.pi, 20))
    radii = generator.uniform(0.03, 0.06, 20)
    vertices = np.stack((radii * np.cos(angles), radii * np.sin(angles)), axis=1)
    start = -vertices[:, 1].min() + 0.01
    low, high = (-0.02, start - 0.05, -0.15), (0.09, start, 0.15)
    commands = [(0.0, start, 0.0), *generator.uniform(low, high, (8, 3))]
    return torch.tensor(vertices), generator.uniform(0.1, 0.9), [vector(*c) for c in commands]


def rollout(truth: MujocoTruth, commands: list[torch.Tensor]) -> np.ndarray:
    return np.array(follow(truth, commands[0].tolist(), *(c.tolist() for c in commands[1:])))


def test_halving_the_time_step_moves_forces_by_a_millinewton_in_the_mean():
    differences = []
    for seed in range(4):
        vertices, friction, commands = random_scene(seed)
        coarse = rollout(make_truth(vertices, friction), commands)
        fine = rollout(make_truth(vertices, friction, time_step=0.001), commands)
        differences.append(np.abs(coarse - fine)[:, 3:])
    differences = np.concatenate(differences)
    assert differences[:, :2].mean() < 1e-3
    assert differences[:, 2].mean() < 3e-3


def test_moving_the_whole_world_leaves_the_wrench():
    vertices, friction, commands = random_scene(5)
    rows = rollout(make_truth(vertices, friction), commands)
    shift = vector(0.05, -0.03, 0)
    moved = rollout(
        make_truth(vertices, friction, floor=-0.03, wall=0.15), [c + shift for c in commands]
    )
    assert np.allclose(moved[:, 3:], rows[:, 3:], atol=2e-3)
    assert np.allclose(moved[:, :3] - shift.numpy(), rows[:, :3], atol=2e-5)


def test_exchanging_floor_and_wall_by_a_mirror_exchanges_the_forces():
    """The mirror x -> -z, z -> -x maps the floor z = 0 to the wall x = 0 and back."""
    vertices, friction, commands = random_scene(6)
    wall = 0.1
    rows = rollout(make_truth(vertices, friction, 0.0, wall), commands)
    mirrored_vertices = -vertices.flip(-1)
    mirrored = rollout(
        make_truth(mirrored_vertices, friction, -wall, 0.0, vector(100, 100, 50)),
        [torch.stack((-c[1], -c[0], -c[2])) for c in commands],
    )
    expected = np.stack([-rows[:, 1], -rows[:, 0], -rows[:, 2], -rows[:, 4], -rows[:, 3],
                         -rows[:, 5]], axis=1)  # fmt: skip
    assert np.allclose(mirrored[:, :3], expected[:, :3], atol=5e-5)
    assert np.allclose(mirrored[:, 3:], expected[:, 3:], atol=FORCE_TOLERANCE)


def test_the_same_commands_give_the_same_bits():
    vertices, friction, commands = random_scene(7)
    truth = make_truth(vertices, friction)
    assert np.array_equal(rollout(truth, commands), rollout(truth, commands))


def test_what_has_no_meaning_is_refused():
    with pytest.raises(ValueError, match="friction"):
        make_truth(friction=-0.1)
    with pytest.raises(ValueError, match="stiffness"):
        make_truth(stiffness=vector(100.0, 0.0, 50.0))
    with pytest.raises(ValueError, match="no area"):
        make_truth(torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]).double())


def test_instability_is_an_error_and_not_an_answer(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SolverError, match="unstable.*lower the time step"):
        make_truth().step(vector(0.0, 1e13, 0.0))
    with pytest.raises(ValueError, match="expected finite numbers"):
        make_truth().step(vector(math.nan, 0.0, 0.0))
    assert not list(tmp_path.iterdir())  # MuJoCo's log file


def test_without_mujoco_the_error_says_what_to_install(monkeypatch):
    load = builtins.__import__

    def fail(name, *args, **kwargs):
        if name == "mujoco":
            raise ImportError(name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", fail)
    with pytest.raises(SolverError, match="mujoco is not installed"):
        make_truth()


@pytest.mark.parametrize("seed", range(5))
def test_the_thinned_hull_supports_the_outline_within_the_tolerance(seed):
    generator = np.random.default_rng(seed)
    angles = np.sort(generator.uniform(0, 2 * np.pi, 400))
    radii = 0.05 + 0.01 * np.cos(3 * angles)
    points = np.stack((radii * np.cos(angles), 1.3 * radii * np.sin(angles)), axis=1)
    thinned = hull_vertices(points, 2e-5)
    directions = np.stack((np.cos(angles), np.sin(angles)))
    loss = (points @ directions).max(0) - (thinned @ directions).max(0)
    assert loss.min() > -1e-12 and loss.max() < 2e-5 + 1e-12
    assert len(thinned) < 0.6 * len(hull_vertices(points, 0.0))
    edges = np.roll(thinned, -1, axis=0) - thinned
    following = np.roll(edges, -1, axis=0)
    assert (edges[:, 0] * following[:, 1] > edges[:, 1] * following[:, 0]).all()
