"""Friction laws, substeps and compliance of the step."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from contact_scenes import (
    OUTLINES,
    SLAB,
    STIFFNESS,
    make_scene,
    outline_points,
    random_transitions,
    vector,
)
from simulator_steps import CLOSE, SIDES, assert_near, step

from tpcd.simulator import ContactMode, StepSettings, simulate_step


@SIDES
def test_convex_friction_lifts_a_sliding_body_by_friction_times_slip(side):
    mu, press, pull = 0.4, 0.03, 0.06
    scene = make_scene(SLAB, friction=mu)
    start, command = vector(0, 0.02, 0), vector(pull * side, 0.02 - press, 0)
    result = step(scene, start, command, friction="anitescu")
    # Minimise (slip - pull)^2 + (lift + press)^2 on lift = mu slip.
    slip = (pull - mu * press) / (1 + mu**2)
    assert_near(result.pose, slip * side, 0.02 + mu * slip, 0)
    real = step(scene, start, command, friction="coulomb")
    assert abs(float(real.pose[1]) - 0.02) < CLOSE


@SIDES
@pytest.mark.parametrize("slip", [3e-8, 5e-7, 2e-6])
def test_where_slip_has_just_begun_the_body_goes_with_the_arm(side, slip):
    mu, press = 0.4, 0.03
    scene, start = make_scene(SLAB, friction=mu), vector(0, 0.02, 0)
    command = vector((mu * press * STIFFNESS[1] / STIFFNESS[0] + slip) * side, 0.02 - press, 0)
    result = step(scene, start, command)
    assert_near(result.pose, slip * side, 0.02, 0)
    # Where it comes from no longer matters, and a floor that gives way changes the load alone.
    torch.testing.assert_close(result.pose_from_start, torch.zeros(3, 3).double())
    assert_near(result.pose_from_gap[0], mu * float(STIFFNESS[1] / STIFFNESS[0]) * side, -1, 0)
    assert int(result.mode[0]) == (
        ContactMode.SLIP_POSITIVE if side > 0 else ContactMode.SLIP_NEGATIVE
    )


def test_with_more_substeps_the_lift_of_convex_friction_goes_to_zero():
    scene = make_scene(SLAB, friction=0.4)
    start, command = vector(0, 0.02, 0), vector(0.06, -0.01, 0)
    exact = step(scene, start, command)
    errors = [
        float((step(scene, start, command, friction="anitescu", substeps=n).pose
               - exact.pose).abs().max())
        for n in (1, 4, 16)
    ]  # fmt: skip
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0] / 8


def test_more_substeps_converge_to_the_path_of_friction():
    scene, start, command = random_transitions(outline_points("egg"), 30, seed=41)
    poses = {
        n: simulate_step(
            scene,
            start,
            command,
            STIFFNESS,
            StepSettings(substeps=n, finest=1.0, follow_path=True),
        ).pose
        for n in (1, 8, 32)
    }
    coarse, fine = ((poses[n] - poses[32]).abs().mean() for n in (1, 8))
    assert float(fine) < 0.35 * float(coarse)


def test_what_is_turned_in_contact_ends_where_a_fine_path_ends():
    """Turns of 0.24 rad from rest on floor, wall or both: rolling and slipping depend on the path.

    Left out is what two fine paths do not agree about, such as what is about to let go.
    """
    errors = {}
    for seed, name in enumerate(OUTLINES):
        scene, start, first = random_transitions(outline_points(name), 60, seed=60 + seed)
        fine = StepSettings(substeps=40, follow_path=True, rounds=40)
        pose = simulate_step(scene, start, first, STIFFNESS, fine).pose
        turned = first + vector(0, 0, 0.24) * -first[:, 2:].sign()
        ends = {
            what: simulate_step(scene, pose, turned, STIFFNESS, settings, previous=first).pose
            for what, settings in {
                "finest": replace(fine, substeps=80),
                "fine": fine,
                "usual": StepSettings(),
                "at once": StepSettings(substeps=1),
            }.items()
        }
        off = {k: (end - ends["finest"])[:, :2].abs().amax(-1) for k, end in ends.items()}
        agreed = off["fine"] < 2e-5
        assert float(agreed.double().mean()) > 0.85
        for what in ("usual", "at once"):
            errors.setdefault(what, []).append(off[what][agreed])
    usual, at_once = (torch.cat(errors[what]) for what in ("usual", "at once"))
    assert float((usual > 1e-4).double().mean()) < 0.02
    assert float(usual.mean()) < 0.25 * float(at_once.mean())


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("compliance", [1e-5, 1e-3, 5e-2])
def test_a_soft_floor_is_a_spring_in_series_with_the_arm(friction, compliance):
    """Also for the two loaded corners of a face: the terrain yields to their sum."""
    scene = make_scene(friction=friction, compliance=compliance)
    result = step(scene, vector(0, 0.05, 0), vector(0, 0.01, 0))
    force = 0.04 / (1 / 100 + compliance)
    assert_near(result.wrench, 0, force, 0, atol=1e-5)
    assert_near(result.pose, 0, 0.05 - compliance * force, 0, atol=1e-7)


def test_three_loaded_rows_on_soft_terrain_balance_springs_in_series():
    """Face on the floor and edge at the wall: each terrain yields to its own load."""
    compliance = 2e-3
    scene = make_scene(friction=0.0, position=0.05, compliance=compliance)
    result = step(scene, vector(0.02, 0.05, 0), vector(0.05, 0.02, 0))
    force = 0.03 / (1 / 100 + compliance)
    assert_near(result.wrench, -force, force, 0, atol=1e-5)
    assert_near(result.pose, 0.02 + compliance * force, 0.05 - compliance * force, 0, atol=1e-7)
