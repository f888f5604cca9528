"""How the command's path is cut: where contact changes on the way, and against slow arms."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from contact_scenes import make_scene

from tpcd.shape.builtin import ENTRIES, make_entry
from tpcd.simulator import StepSettings, simulate_step
from tpcd.simulator.walk import ends_alike, part_end, parts_of_path
from tpcd.truth.mujoco_truth import MujocoSettings, MujocoTruth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import Scene, draw_scene, make_truth

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
    found = ends_alike(torch.tensor([before]), torch.tensor([now]))
    assert found.tolist() == [alike]


@pytest.mark.parametrize("terrains", [1, 2, 3])
def test_compiled_loops_cut_as_torch_does(terrains):
    kernel = pytest.importorskip("tpcd.simulator.kernel_walk")
    modes = list(itertools.product(range(4), repeat=terrains))
    settings = StepSettings(substeps=3, largest_turn=0.1)
    request = SimpleNamespace(substeps=3, largest_turn=0.1, follow_path=False)
    for before, now in itertools.product(modes, modes):
        rows = (torch.tensor([before]), torch.tensor([now]))
        codes = [sum(mode << 2 * t for t, mode in enumerate(each)) for each in (before, now)]
        assert kernel.ends_alike(*codes, terrains) == bool(ends_alike(*rows))
        for turn in (0.0, 0.3, -0.41):
            parts = parts_of_path(settings, torch.tensor([turn], dtype=torch.float64), *rows)
            assert kernel.parts_of_path.py_func(request, turn, *codes, terrains) == int(parts)


def test_parts_end_at_their_grid_and_at_the_command():
    kernel = pytest.importorskip("tpcd.simulator.kernel_walk")
    done, length = torch.tensor([0.0, 0.25, 0.3, 0.5, 0.99]).double(), 0.25
    expected = [0.25, 0.5, 0.5, 0.75, 1.0]
    found = part_end(done, torch.full_like(done, length), torch.full((5,), 4))
    torch.testing.assert_close(found, torch.tensor(expected).double())
    for start, end in zip(done.tolist(), expected, strict=True):
        assert kernel.part_end(start, length, 4) == pytest.approx(end)


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


def test_both_engines_walk_alike():
    """Every answer, where parts are halved: modes, forces and derivatives too."""
    pytest.importorskip("numba")
    halved = 0
    for scene, commands in moved_scenes()[3:7]:
        truth = by_model(scene, commands)
        model = make_scene(
            scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position
        )
        asked = (model, truth[:-1], commands[1:], scene.stiffness)
        found, other, coarse = (
            simulate_step(*asked, settings, engine, previous=commands[:-1])
            for settings, engine in (
                (StepSettings(), "native"),
                (StepSettings(), "torch"),
                (StepSettings(finest=1.0), "native"),
            )
        )
        assert torch.equal(found.mode, other.mode) and torch.equal(found.status, other.status)
        # Between two terrains, forces answer ten thousandfold to where it has settled [N/m].
        for name, near in (
            ("pose", 1e-6),
            ("contacts", 1e-3),
            ("pose_from_start", 1e-3),
            ("pose_from_gap", 1e-3),
            ("pose_from_lever", 1e-3),
        ):
            ours, theirs = getattr(found, name), getattr(other, name)
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=near, msg=name)
        halved += int(((found.pose - coarse.pose).abs().amax(-1) > 1e-6).sum())
    assert halved >= 3


def test_large_moves_end_where_a_slow_arm_in_mujoco_comes_to_rest():
    """Parts that are halved where contact changes are worth it, and so is a slow truth."""
    pytest.importorskip("mujoco")
    usual, at_once = StepSettings(), StepSettings(finest=1.0, substeps=2, largest_turn=0.05)
    slow, fast = MujocoSettings(), MujocoSettings(ramp_speed=(math.inf, math.inf))
    off = {what: [] for what in ("usual", "at once", "fast")}
    for scene, commands in moved_scenes():
        truth = by_mujoco(scene, commands, slow)
        off["usual"].append(off_from(truth, scene, commands, usual))
        off["at once"].append(off_from(truth, scene, commands, at_once))
        hurried = by_mujoco(scene, commands, fast)
        off["fast"].append(off_from(hurried, scene, commands, usual))
    mean = {what: float(torch.cat(each).mean()) for what, each in off.items()}
    print(mean)
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
