"""Planar motions as a group, and angles on the circle."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tpcd.planar import compose, inverse, perpendicular, rotate, transform_points, wrap_angle

COORDINATES = st.tuples(
    st.floats(-5, 5), st.floats(-5, 5), st.floats(-math.pi + 1e-6, math.pi)
).map(lambda values: torch.tensor(values, dtype=torch.float64))


def near(first, second):
    difference = first - second
    turn = wrap_angle(difference[..., 2])
    return float(difference[..., :2].abs().max()) < 1e-9 and float(turn.abs().max()) < 1e-9


@given(COORDINATES)
def test_a_pose_and_its_inverse_are_the_identity(pose):
    identity = torch.zeros(3, dtype=torch.float64)
    assert near(compose(pose, inverse(pose)), identity)
    assert near(compose(inverse(pose), pose), identity)


@given(COORDINATES, COORDINATES, COORDINATES)
def test_composition_is_associative(first, second, third):
    assert near(compose(compose(first, second), third), compose(first, compose(second, third)))


@given(COORDINATES, COORDINATES)
def test_composing_poses_composes_their_maps_of_points(first, second):
    points = torch.tensor([[0.3, -0.2], [1.0, 2.0]], dtype=torch.float64)
    both = transform_points(compose(first, second), points)
    torch.testing.assert_close(both, transform_points(first, transform_points(second, points)))


@given(st.floats(-50, 50))
def test_wrapped_angles_lie_in_the_half_open_turn(angle):
    wrapped = float(wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@pytest.mark.parametrize("angle", [math.pi, -math.pi, 3 * math.pi])
def test_half_a_turn_wraps_to_plus_pi(angle):
    assert float(wrap_angle(torch.tensor(angle, dtype=torch.float64))) == pytest.approx(math.pi)


def test_the_perpendicular_is_the_derivative_of_a_rotation():
    vectors = torch.tensor([[1.0, 0.0], [0.3, -0.7]], dtype=torch.float64)
    eps = torch.tensor(1e-7, dtype=torch.float64)
    difference = (rotate(eps, vectors) - rotate(-eps, vectors)) / (2 * eps)
    torch.testing.assert_close(difference, perpendicular(vectors), atol=1e-9, rtol=0)


def test_batches_broadcast():
    poses = torch.zeros(4, 1, 3, dtype=torch.float64)
    assert compose(poses, torch.zeros(5, 3, dtype=torch.float64)).shape == (4, 5, 3)
    assert transform_points(torch.zeros(4, 3), torch.zeros(7, 2)).shape == (4, 7, 2)
