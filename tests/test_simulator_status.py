"""A good status is true: what is called converged is at rest, whatever was asked."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from contact_scenes import (
    BOX,
    OUTLINES,
    STIFFNESS,
    make_scene,
    many_random_transitions,
    outline_points,
    vector,
)
from simulator_steps import FRICTIONS
from torch import Tensor

from tpcd.contact import ContactScene, terrain_gaps
from tpcd.data.header import parse_header
from tpcd.errors import EpisodeError
from tpcd.parameters import LARGEST_FRICTION
from tpcd.planar import transform_points, wrap_angle
from tpcd.simulator import StepSettings, StepStatus, Transition, simulate_step
from tpcd.simulator.record import START_DEPTH
from tpcd.truth.scene import draw_scene

DEPTH = 1e-6
"""What is converged is no deeper inside a terrain than this [m], ten times the tolerance."""


def rough(scene: ContactScene, friction: float) -> ContactScene:
    return replace(scene, friction=torch.full_like(scene.friction, friction))


def depth(scene: ContactScene, found: Transition) -> Tensor:
    """How deep the answers are inside terrains that have yielded to their load [m]."""
    gaps = terrain_gaps(scene, found.pose)
    return -(gaps.amin(-1) + scene.compliance * found.contacts[..., 0]).amin(-1)


@FRICTIONS
@pytest.mark.parametrize("friction", [1e3, 1e5, 1e6, 1e8, math.inf, -0.1])
def test_friction_beyond_its_bounds_has_no_answer_and_names_them(friction_law, friction):
    scene, start, command = many_random_transitions(5, 0)
    settings = StepSettings(friction=friction_law)
    found = simulate_step(rough(scene, friction), start, command, STIFFNESS, settings)
    assert (found.status == StepStatus.INVALID_INPUT).all() and found.pose.isnan().all()
    assert f"0 to {LARGEST_FRICTION:g}" in StepStatus.INVALID_INPUT.sentence


@FRICTIONS
@pytest.mark.parametrize("friction", [1.0, 10.0, 30.0, LARGEST_FRICTION])
def test_what_is_converged_is_outside_of_all_terrain_however_rough_it_is(friction_law, friction):
    """Also where the settings say that all is gone at once: then nothing else is the answer."""
    scene, start, command = many_random_transitions(25, 0)
    scene = rough(scene, friction)
    whole = StepSettings(friction=friction_law, substeps=1)
    for settings in (replace(whole, substeps=2), whole):
        found = simulate_step(scene, start, command, STIFFNESS, settings)
        converged = found.status == StepStatus.CONVERGED
        assert float(converged.double().mean()) > 0.2
        assert float(depth(scene, found)[converged].max()) <= DEPTH
        assert float(found.residual[converged].max()) <= DEPTH


@pytest.mark.parametrize("seed", range(4))
def test_what_is_converged_is_at_rest_at_any_stiffness_size_angle_and_distance(seed):
    """Springs of 1e-3 to 1e9, outlines of 10 um to 10 m, turns of 1e6 rad, ways of 100 m, starts
    inside and outside, terrain that yields: no depth, no force outside of the friction cone, and a
    wrench that is the sum of the forces."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    def log(low: float, high: float, *shape: int) -> Tensor:
        return torch.exp(uniform(math.log(low), math.log(high), *shape))

    n, good = 400, 0
    for name in OUTLINES:
        points = log(1e-4, 1e2, n)[:, None, None] * outline_points(name)
        extent = points.norm(dim=-1).amax(-1)
        few = uniform(0, 1, n) < 0.5
        scene = make_scene(
            points,
            torch.where(few, log(1e-3, LARGEST_FRICTION, n), 0.5),
            uniform(-0.02, 0.02, n),
            uniform(-0.05, 0.2, n),
            torch.where(uniform(0, 1, n) < 0.3, log(1e-9, 1e-2, n), 0.0)[:, None],
        )
        angle = torch.where(uniform(0, 1, n) < 0.2, uniform(-1e6, 1e6, n), uniform(-3, 3, n))
        turned = transform_points(torch.stack((0 * angle, 0 * angle, angle), -1), points)
        inside = uniform(-0.5, 0.2, n, 2) * extent[:, None]
        place = torch.stack(
            (
                -scene.terrains[1].offset - turned[..., 0].amax(-1) + inside[:, 0],
                scene.terrains[0].offset - turned[..., 1].amin(-1) - inside[:, 1],
            ),
            -1,
        )
        start = torch.cat((place, angle[:, None]), -1)
        far = torch.where(uniform(0, 1, n) < 0.2, 100.0, 2.0 * extent)[:, None]
        turn = torch.where(uniform(0, 1, n) < 0.2, 1e6, 0.5)[:, None]
        move = torch.cat((far * uniform(-1, 1, n, 2), turn * uniform(-1, 1, n, 1)), -1)
        stiffness = torch.where(few[:, None], log(1e-3, 1e9, n, 3), STIFFNESS)
        command = start + move
        found = simulate_step(scene, start, command, stiffness, unusual=True)
        true = found.status <= StepStatus.START_INSIDE
        good += int(true.sum())
        assert torch.isfinite(found.pose[true]).all() and torch.isfinite(found.wrench[true]).all()
        assert float(depth(scene, found)[true].max()) <= DEPTH
        load, drag = found.contacts[..., 0], found.contacts[..., 1]
        assert (load[true] >= 0).all()
        cone = drag.abs() - scene.friction * load
        assert (cone <= 1e-9 * load)[true].all()
        normals = torch.stack([body.direction for body in scene.terrains], -2)
        along = torch.stack((normals[..., 1], -normals[..., 0]), -1)
        force = (load[..., None] * normals + drag[..., None] * along).sum(-2)
        # Forces of springs that differ a millionfold cancel to what rounding leaves of the largest.
        rounding = 1e-12 * load.sum(-1, keepdim=True) / stiffness[:, :2]
        off = (found.wrench[:, :2] - force).abs() / stiffness[:, :2]
        assert (off <= 10 * DEPTH + rounding)[true].all()
    assert good > 0.7 * n * len(OUTLINES)


@pytest.mark.parametrize("previous", [None, vector(0.0, 0.05, 0.0)])
def test_a_start_inside_a_terrain_is_told_unless_a_measurement_may_be_that_wrong(previous):
    inside = vector(0.9 * START_DEPTH, 1.1 * START_DEPTH, 0.03)
    start = vector(0, 0.05, 0) - inside[:, None] * vector(0, 1, 0)
    command = vector(0, 0.04, 0)
    found = simulate_step(make_scene(BOX), start, command, STIFFNESS, previous=previous)
    assert found.status.tolist() == [
        StepStatus.CONVERGED,
        StepStatus.START_INSIDE,
        StepStatus.START_INSIDE,
    ]
    torch.testing.assert_close(found.pose[:, 1], vector(0.05, 0.05, 0.05))
    assert "inside a terrain" in StepStatus.START_INSIDE.sentence


def test_an_object_that_a_soft_floor_has_yielded_to_starts_on_it():
    """Pressed with 4 N it stands 4 mm inside the undeformed floor: that is where it rests."""
    scene = make_scene(BOX, compliance=1e-3)
    pressed = simulate_step(scene, vector(0, 0.05, 0), vector(0, 0.006, 0), STIFFNESS)
    assert float(pressed.pose[1]) < 0.05 - 3 * START_DEPTH
    again = simulate_step(
        scene,
        pressed.pose,
        vector(0, 0.0, 0),
        STIFFNESS,
        previous=vector(0, 0.006, 0),
    )
    assert int(again.status) == StepStatus.CONVERGED


def test_an_object_that_turns_round_under_a_soft_spring_is_not_at_rest():
    """Pressed by kilonewtons, with springs about y that turn it for less than half a newton metre:
    what is called converged has the wrench of the angle that is told, which is within half a turn
    of the command."""
    random = torch.Generator().manual_seed(0)
    draws = torch.rand(60, 3, generator=random, dtype=torch.float64)
    command = vector(-0.05, 0.05, -0.2) + vector(0.1, -0.2, 0.4) * draws
    stiffness = vector(1e5, 1e5, 0.1)
    scene = make_scene(BOX.expand(60, *BOX.shape))
    start = vector(0, 0.1, 0).expand(60, 3)
    found = simulate_step(scene, start, command, stiffness)
    good = found.status <= StepStatus.START_INSIDE
    assert 5 < good.sum() < 60
    stretched = found.pose - command
    stretched[:, 2] = wrap_angle(stretched[:, 2])
    torch.testing.assert_close((stiffness * stretched)[good], found.wrench[good])
    assert (found.residual[~good] > StepSettings().tolerance).all()


def test_a_scene_or_a_prior_with_more_friction_is_refused_with_the_bound(tmp_path):
    corners = BOX.numpy()
    draw_scene("box", corners, torch.Generator(), fixed={"friction": LARGEST_FRICTION})
    for friction in (1.01 * LARGEST_FRICTION, 1e6, math.inf):
        with pytest.raises(ValueError, match=f"friction is .*expected 0 to {LARGEST_FRICTION:g}"):
            draw_scene("box", corners, torch.Generator(), fixed={"friction": friction})
    known = {"stiffness": [100, 100, 50], "priors": {"friction": [0.1, 1e5]}}
    with pytest.raises(EpisodeError, match=f"at most {LARGEST_FRICTION:g}"):
        parse_header(known, tmp_path / "e.yaml")
