"""How the command's path is cut: where contact changes on the way, derivatives of that, and against
paths of many parts and slow arms."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from contact_scenes import BOX, STIFFNESS, flush_corner, make_scene, vector

from tpcd.contact import scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.shape.builtin import make_entry
from tpcd.shape.household import ENTRIES
from tpcd.simulator import StepSettings, simulate_step
from tpcd.simulator.path import (
    AIM,
    GLANCE,
    LOOK,
    SHY,
    TRY,
    ends_alike,
    next_part,
    part_end,
    shorter_part,
)
from tpcd.truth.make import make_truth
from tpcd.truth.mujoco_truth import MujocoSettings, MujocoTruth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import Scene, draw_scene

FREE, STICK, RIGHT, LEFT = 0, 1, 2, 3
OFF = 5e-5
"""A transition that ends so far from another answer ends elsewhere [m]."""
STEPS = 15
MOVED = tuple(sorted(ENTRIES))[::3]


@pytest.mark.parametrize(
    ("before", "now", "alike"),
    [
        ((STICK, FREE), (STICK, FREE), True),
        ((STICK, FREE), (RIGHT, FREE), True),
        ((LEFT, FREE), (RIGHT, FREE), True),
        ((LEFT, STICK), (FREE, FREE), True),
        ((FREE, FREE), (STICK, FREE), True),
        ((RIGHT, FREE), (STICK, FREE), False),
        ((FREE, STICK), (RIGHT, FREE), False),
        ((RIGHT, STICK), (RIGHT, FREE), False),
        ((FREE, FREE), (RIGHT, STICK), False),
        ((RIGHT, LEFT), (RIGHT, STICK), False),
    ],
)
def test_only_what_the_way_decides_is_cut(before, now, alike):
    codes = [sum(mode << 2 * t for t, mode in enumerate(each)) for each in (before, now)]
    assert ends_alike(*codes, 2, True) == alike
    # Where nothing slid, only what else is touched can make a difference.
    touched_alike = [b == FREE for b in before] == [n == FREE for n in now]
    assert ends_alike(*codes, 2, False) == (alike or touched_alike)


def test_parts_end_at_their_grid_and_at_the_command():
    for start, end in ((0.0, 0.25), (0.25, 0.5), (0.3, 0.5), (0.5, 0.75), (0.99, 1.0)):
        assert part_end(start, 0.25, 4) == pytest.approx(end)


def test_an_expected_change_is_aimed_at_and_then_looked_at():
    assert next_part(False, True, 0.2, 0.5) == (AIM, pytest.approx(SHY * 0.2))
    assert next_part(True, True, 0.2, 0.5) == (LOOK, GLANCE)
    assert next_part(False, False, 0.2, 0.5) == (TRY, 0.5)
    assert next_part(False, True, 1.5, 0.5) == (TRY, 0.5)
    assert shorter_part(AIM, True, 0.2, 0.2, 1 / 32) == (AIM, pytest.approx(0.1))


def off_from(truth: torch.Tensor, scene: Scene, commands: torch.Tensor, settings: StepSettings):
    """How far single steps from the poses of a truth end from its next ones [m]."""
    model = make_scene(scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position)
    found = simulate_step(
        model, truth[:-1], commands[1:], scene.stiffness, settings, previous=commands[:-1]
    )
    return (found.pose - truth[1:])[:, :2].abs().amax(-1)


@cache
def moved_scenes() -> list[tuple[Scene, torch.Tensor]]:
    """Scenes, and the commands of a rich exploration with large moves."""
    found = []
    for k, name in enumerate(MOVED):
        generator = torch.Generator().manual_seed(700 + k)
        scene = draw_scene(name, make_entry(name, ENTRIES[name]).vertices, generator)
        motion = make_motion("rich", scene, STEPS, generator)
        truth = make_truth(scene, "quasistatic")
        recording = record(truth, scene, motion, STEPS, generator)
        found.append((scene, recording.true.commands))
    return found


def by_model(scene: Scene, commands: torch.Tensor) -> torch.Tensor:
    """Poses at which the project's own truth comes to rest."""
    truth = make_truth(scene, "quasistatic")
    truth.reset(scene.start_pose)
    return torch.stack([scene.start_pose, *(truth.step(command)[0] for command in commands[1:])])


def by_mujoco(scene: Scene, commands: torch.Tensor, settings: MujocoSettings) -> torch.Tensor:
    """Poses at which MuJoCo comes to rest."""
    truth = MujocoTruth(
        scene.vertices_ee,
        scene.friction,
        scene.floor_height,
        scene.wall_position,
        scene.stiffness,
        settings,
    )
    truth.reset(scene.start_pose)
    return torch.stack([scene.start_pose, *(truth.step(command)[0] for command in commands[1:])])


def test_in_a_corner_a_step_ends_where_the_path_leads():
    """Where nothing slides, rows that carry load may change without end: that is no change."""
    prior, vectors, start, before, command = flush_corner(150)
    scene = scene_from_parameters(prior.shape, Parameters.from_vector(vectors)).double()
    asked = (scene, start.expand(150, 3), command, STIFFNESS)
    fine = StepSettings(substeps=300, finest=1.0, follow_path=True, rounds=40)
    found, truth = (
        simulate_step(*asked, settings, previous=before).pose[:, :2]
        for settings in (StepSettings(), fine)
    )
    assert int(((found - truth).abs().amax(-1) > 5e-5).sum()) <= 2


def test_what_changes_here_and_now_does_not_multiply_derivatives():
    """A box stands flush at a wall, with one corner held and another about to be touched."""
    generator = torch.Generator().manual_seed(1)
    noise = 1e-4 * torch.randn(2, 2000, 3, generator=generator).double()
    start = vector(0.276186, 0.0435023, 0.000933) + noise[0]
    command = vector(0.271535, 0.0506291, -0.010457) + noise[1]
    scene = make_scene(BOX, 0.9, 0.0, 0.3)
    found = simulate_step(scene, start, command, STIFFNESS, previous=start)
    for name in ("pose_from_start", "pose_from_gap", "pose_from_lever"):
        assert float(getattr(found, name).abs().max()) < 10.0


def moved_transitions() -> list[tuple[Scene, torch.Tensor, torch.Tensor]]:
    """Scenes, poses at rest and commands, of the project's own truth."""
    return [(scene, by_model(scene, commands), commands) for scene, commands in moved_scenes()]


def model_of(scene: Scene, floor: float = 0.0, wall: float = 0.0):
    """The scene with its terrains moved [m]."""
    return make_scene(
        scene.vertices_ee,
        scene.friction,
        scene.floor_height + floor,
        scene.wall_position + wall,
    )


def test_paths_end_where_those_of_many_parts_do():
    """Changes of contact that are located stand for a path in 300 parts."""
    fine = StepSettings(substeps=300, finest=1.0, follow_path=True, rounds=40)
    usual, at_once = StepSettings(), StepSettings(finest=1.0)
    off = {usual: [], at_once: []}
    for scene, truth, commands in moved_transitions():
        asked = (model_of(scene), truth[:-1], commands[1:], scene.stiffness)
        end = simulate_step(*asked, fine, previous=commands[:-1]).pose
        for settings, found in off.items():
            pose = simulate_step(*asked, settings, previous=commands[:-1]).pose
            found.append((pose - end)[:, :2].abs().amax(-1))
    share = {k: float((torch.cat(v) > OFF).double().mean()) for k, v in off.items()}
    assert share[usual] < 0.03
    assert share[usual] < 0.5 * share[at_once]


def slopes_of(ends: list[torch.Tensor], size: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Central difference of poses after steps of `SIZES` times a size, and where it is smooth: what
    goes over a kink is told by the two widths differing."""
    wide, narrow = (ends[0] - ends[1]) / (2 * size), (ends[2] - ends[3]) / (0.6 * size)
    return wide, (wide - narrow).abs() < 1e-2 * (1 + wide.abs().amax(-1, keepdim=True))


SIZES = (1.0, -1.0, 0.3, -0.3)
EXACT = StepSettings(tolerance=1e-12)


def test_derivatives_know_that_the_place_of_a_change_moves():
    """Central differences by start, floor and wall where changes of contact were located."""
    size, errors = 1e-6, []
    for scene, truth, commands in moved_transitions():

        def step(start, settings=EXACT, scene=scene, commands=commands, **moved):
            asked = (model_of(scene, **moved), start, commands[1:], scene.stiffness)
            return simulate_step(*asked, settings, previous=commands[:-1])

        here, start = step(truth[:-1]), truth[:-1]
        cut = step(start, replace(EXACT, finest=1.0)).pose
        located = (here.pose - cut).abs().amax(-1) > 1e-6
        by_start, axes = here.pose_from_start.unbind(-1), torch.eye(3, dtype=torch.float64)
        # A gap grows as the floor sinks, and as the wall at +x recedes.
        for closed, ends in (
            *(
                (closed, [step(start + s * size * axis) for s in SIZES])
                for closed, axis in zip(by_start, axes, strict=True)
            ),
            (here.pose_from_gap[:, 0], [step(start, floor=-s * size) for s in SIZES]),
            (here.pose_from_gap[:, 1], [step(start, wall=s * size) for s in SIZES]),
        ):
            slope, smooth = slopes_of([end.pose for end in ends], size)
            error = (slope - closed).abs().amax(-1) / (1 + slope.abs().amax(-1))
            errors.append(error[located & smooth.all(-1)])
    errors = torch.cat(errors)
    assert len(errors) > 50
    assert float((errors < 1e-2).double().mean()) > 0.97


def test_autograd_knows_that_the_place_of_a_change_moves():
    """Through the outline's points and friction, against central differences."""
    size, errors = 1e-6, []
    for scene, truth, commands in moved_transitions()[6:10]:
        asked = (model_of(scene), truth[:-1], commands[1:], scene.stiffness)
        whole, cut = (
            simulate_step(*asked, settings, previous=commands[:-1]).pose
            for settings in (EXACT, replace(EXACT, finest=1.0))
        )
        located = torch.nonzero((whole - cut).abs().amax(-1) > 1e-6).flatten()
        rows = (truth[located], commands[located + 1], commands[located])
        zero = torch.zeros(len(located), dtype=torch.float64)

        def step(larger, rougher, scene=scene, rows=rows, zero=zero):
            points = scene.vertices_ee * (1 + larger[:, None, None])
            floor, wall = zero + scene.floor_height, zero + scene.wall_position
            model = make_scene(points, scene.friction * (1 + rougher), floor, wall)
            start, command, before = rows
            step = (start, command, scene.stiffness, EXACT)
            return simulate_step(model, *step, previous=before).pose

        larger, rougher = zero.clone().requires_grad_(), zero.clone().requires_grad_()
        pose = step(larger, rougher)
        ends = [
            [step(zero + s * size, zero) for s in SIZES],
            [step(zero, zero + s * size) for s in SIZES],
        ]
        for axis in range(3):
            found = torch.autograd.grad(pose[:, axis].sum(), (larger, rougher), retain_graph=True)
            for closed, each in zip(found, ends, strict=True):
                slope, smooth = slopes_of(each, size)
                error = (slope[:, axis] - closed).abs() / (0.02 + slope[:, axis].abs())
                errors.append(error[smooth.all(-1)])
    errors = torch.cat(errors)
    assert len(errors) > 40
    assert float((errors < 2e-2).double().mean()) > 0.95


def test_large_moves_end_where_a_slow_arm_in_mujoco_comes_to_rest():
    """Guards what was measured: locating changes is worth it, and so is a slow truth."""
    pytest.importorskip("mujoco")
    usual, at_once = StepSettings(), StepSettings(finest=1.0)
    slow, fast = MujocoSettings(), MujocoSettings(ramp_speed=(math.inf, math.inf))
    off = {what: [] for what in ("usual", "at once", "fast")}
    for scene, commands in moved_scenes():
        truth = by_mujoco(scene, commands, slow)
        off["usual"].append(off_from(truth, scene, commands, usual))
        off["at once"].append(off_from(truth, scene, commands, at_once))
        hurried = by_mujoco(scene, commands, fast)
        off["fast"].append(off_from(hurried, scene, commands, usual))
    mean = {what: float(torch.cat(each).mean()) for what, each in off.items()}
    assert mean["usual"] < 2e-5
    assert mean["usual"] < 0.7 * mean["at once"]
    assert mean["usual"] < 0.7 * mean["fast"]


def test_a_truth_at_half_the_speed_is_the_same():
    pytest.importorskip("mujoco")
    usual = MujocoSettings()
    half = replace(usual, ramp_speed=tuple(0.5 * v for v in usual.ramp_speed))
    off = [
        np.abs((by_mujoco(*each, usual) - by_mujoco(*each, half)).numpy())[:, :2].max(-1)
        for each in moved_scenes()[:2]
    ]
    assert float(np.mean(np.concatenate(off) > OFF)) < 0.05
