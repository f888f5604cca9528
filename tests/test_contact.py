"""Contact geometry: gaps, frames and Jacobians, and the scan for the lowest points."""

from __future__ import annotations

import torch
from contact_scenes import BOX, make_scene, outline_points, random_transitions, vector

from tpcd.contact import ContactScene, contact_frame, place_points, terrain_gaps
from tpcd.planar import rotate
from tpcd.terrain import HalfPlane


def test_gaps_of_a_box_over_floor_and_wall():
    scene = make_scene(height=0.01, position=0.1)
    gaps, levers = terrain_gaps(scene.points_ee, scene.terrains, vector(0.02, 0.08, 0.0))
    torch.testing.assert_close(gaps[0], vector(0.02, 0.02, 0.12, 0.12))
    torch.testing.assert_close(gaps[1], vector(0.11, 0.05, 0.05, 0.11))
    torch.testing.assert_close(levers[0], BOX[:, 0])
    torch.testing.assert_close(levers[1], BOX[:, 1])


def test_rows_are_the_derivatives_of_gap_and_tangential_position():
    scene, start, _ = random_transitions(outline_points("mug"), 20, seed=1)
    index = torch.arange(3).expand(20, 3)
    for body in scene.terrains:
        frame = contact_frame(scene.points_ee, body, start, index)
        for axis in range(3):
            step = torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor(axis), 1e-6)
            up, down = (
                contact_frame(scene.points_ee, body, start + sign * step, index) for sign in (1, -1)
            )
            torch.testing.assert_close(
                (up.gap - down.gap) / 2e-6, frame.normal_row[..., axis], atol=1e-8, rtol=0
            )
            along = ((up.points_world - down.points_world) * frame.tangent).sum(-1) / 2e-6
            torch.testing.assert_close(along, frame.tangent_row[..., axis], atol=1e-8, rtol=0)


def test_tangents_point_along_the_floor_to_the_right_and_up_the_wall():
    scene = make_scene()
    index = torch.tensor([0])
    floor, wall = (
        contact_frame(scene.points_ee, body, vector(0, 0.1, 0.3), index) for body in scene.terrains
    )
    torch.testing.assert_close(floor.tangent[0], vector(1.0, 0.0))
    torch.testing.assert_close(wall.tangent[0], vector(0.0, 1.0))


def test_points_are_scaled_then_mounted():
    mount = vector(0.01, -0.02, 0.3)
    placed = place_points(BOX, torch.tensor(1.2).double(), mount)
    torch.testing.assert_close(placed, rotate(mount[2], 1.2 * BOX) + mount[:2])


def test_gathering_takes_scenes_from_the_flat_batch():
    scene, _, _ = random_transitions(outline_points("egg"), 6, seed=2)
    grid = ContactScene(
        scene.points_ee.reshape(2, 3, -1, 2),
        tuple(
            HalfPlane(body.direction.reshape(2, 3, 2), body.offset.reshape(2, 3))
            for body in scene.terrains
        ),
        scene.friction.reshape(2, 3, 2),
    )
    index = torch.tensor([4, 0])
    taken = grid.gather(index)
    assert grid.batch_shape == (2, 3) and taken.batch_shape == (2,)
    assert torch.equal(taken.points_ee, scene.points_ee[index])
    assert torch.equal(taken.terrains[1].offset, scene.terrains[1].offset[index])


class Slope:
    """A half-plane that does not say that it is one."""

    def __init__(self, plane: HalfPlane) -> None:
        self.plane = plane

    def signed_distance(self, points_world):
        return self.plane.signed_distance(points_world)

    def normal(self, points_world):
        return self.plane.normal(points_world)

    def double(self):
        return self

    def gather(self, index):
        return Slope(self.plane.gather(index))
