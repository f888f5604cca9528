"""The plane of the task: poses and wrenches of six numbers become three and come back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tpcd.robot.frames import (
    out_of_plane,
    planar_pose,
    planar_wrench,
    task_frame,
    tcp_pose,
    tcp_wrench,
)

TOOL_DOWN = np.array([0.4, -0.2, 0.3, math.pi, 0.0, 0.0])
"""A tool that points down, 0.3 m over the base."""
coordinate = st.floats(-0.5, 0.5)


@given(coordinate, coordinate, st.floats(-1.5, 1.5), st.sampled_from(["x", "-x", "y", "tool_x"]))
def test_there_and_back_is_the_same_pose(x: float, z: float, angle: float, axis: str) -> None:
    frame = task_frame(TOOL_DOWN, axis, "z")
    pose = np.array([x, z, angle])
    tcp = tcp_pose(frame, pose)
    np.testing.assert_allclose(planar_pose(frame, tcp), pose, atol=1e-9)
    assert out_of_plane(frame, tcp) == pytest.approx((0.0, 0.0), abs=1e-7)


@given(st.lists(st.floats(-20, 20), min_size=3, max_size=3))
def test_there_and_back_is_the_same_wrench(values: list[float]) -> None:
    frame = task_frame(TOOL_DOWN, "-y", "z")
    wrench = np.array(values)
    np.testing.assert_allclose(planar_wrench(frame, tcp_wrench(frame, wrench)), wrench, atol=1e-9)


def test_phi_turns_from_x_towards_z() -> None:
    frame = task_frame(TOOL_DOWN, "-x", "z")
    level, tilted = (
        Rotation.from_rotvec(tcp_pose(frame, np.array([0.0, 0.0, angle]))[3:])
        for angle in (0.0, 0.1)
    )
    turned = (tilted * level.inv()).apply(frame.x_axis)
    expected = math.cos(0.1) * frame.x_axis + math.sin(0.1) * frame.z_axis
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_a_force_from_the_floor_beside_the_end_effector_turns_it() -> None:
    """F_z at lever x has the moment x F_z about the end effector, and from x towards z it is
    positive; in three dimensions that is r × f."""
    for x_axis in ("x", "-x", "-y"):
        frame = task_frame(TOOL_DOWN, x_axis, "z")
        lever, force = 0.05 * frame.x_axis, 8.0 * frame.z_axis
        found = planar_wrench(frame, np.concatenate((force, np.cross(lever, force))))
        np.testing.assert_allclose(found, [0.0, 8.0, 0.4], atol=1e-12)


def test_a_force_along_base_axes_keeps_its_sign_on_a_reversed_x() -> None:
    frame = task_frame(TOOL_DOWN, "-x", "z")
    found = planar_wrench(frame, np.array([3.0, 5.0, 7.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(found, [-3.0, 7.0, 0.0], atol=1e-12)


def test_the_world_begins_at_the_origin_and_the_plane_goes_through_the_tool() -> None:
    frame = task_frame(TOOL_DOWN, "x", "z", origin=(0.1, 0.7, 0.05))
    np.testing.assert_allclose(planar_pose(frame, TOOL_DOWN), [0.3, 0.25, 0.0], atol=1e-12)
    assert out_of_plane(frame, TOOL_DOWN)[0] == pytest.approx(0.0)
    aside = TOOL_DOWN + np.array([0, 0.01, 0, 0, 0, 0])
    assert out_of_plane(frame, aside)[0] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("x_axis", "z_axis", "said"),
    [("up", "z", "x_axis is 'up'"), ("x", "-x", "180.0 degrees"), ("tool_x", "x", "0.0 degrees")],
)
def test_axes_that_span_no_plane_are_refused(x_axis: str, z_axis: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        task_frame(TOOL_DOWN, x_axis, z_axis)
