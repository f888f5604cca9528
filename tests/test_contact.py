"""Scenes of contact: placed outlines, batches, and what is no terrain."""

from __future__ import annotations

import pytest
import torch
from contact_scenes import BOX, make_scene, outline_points, random_transitions, vector

from tpcd.contact import ContactScene, place_points, terrain_gaps
from tpcd.planar import rotate
from tpcd.terrain import HalfPlane


def test_gaps_of_a_box_over_floor_and_wall():
    scene = make_scene(height=0.01, position=0.1)
    gaps = terrain_gaps(scene, vector(0.02, 0.08, 0.0))
    torch.testing.assert_close(gaps[0], vector(0.02, 0.02, 0.12, 0.12))
    torch.testing.assert_close(gaps[1], vector(0.11, 0.05, 0.05, 0.11))


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


def test_what_is_no_half_plane_is_refused():
    with pytest.raises(TypeError, match="HalfPlane"):
        ContactScene(BOX, (make_scene().terrains[0], [0.0, 1.0]), vector(0.4, 0.4))
