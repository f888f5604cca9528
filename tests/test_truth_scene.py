"""Scenes, motions and recordings: what is drawn, what is felt, what is written."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tpcd.data import check_episode, read_episode
from tpcd.errors import EpisodeError, RobotError
from tpcd.parameters import DEFAULT_BOUNDS, SCENE_NAMES
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.motions import FORCE_LIMIT, LARGEST_TILT, History, PlannedMotion, planned_test
from tpcd.truth.recording import (
    check_truth,
    make_motion,
    read_truth,
    record,
    write_recording,
)
from tpcd.truth.scene import Scene, draw_scene

SIMULATE = Path(__file__).parents[1] / "scripts" / "simulate.py"
TOUCHING = 2e-4
OUTLINES = builtin_outlines()
OBJECTS = ("mug", "soup_can", "book", "pear", "bank_card")


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene_of(name: str, seed: int, **options) -> Scene:
    return draw_scene(name, OUTLINES[name].vertices, generator(seed), **options)


class FlatFloor:
    """A truth in closed form: the hand itself stops at z = 0.05 without friction."""

    def reset(self, pose):
        """Nothing to remember."""

    def step(self, command):
        """The hand goes where it is told, but no lower."""
        pose = torch.cat((command[:1], command[1:2].clamp(min=0.05), command[2:]))
        return pose, torch.tensor([100.0, 100.0, 50.0]).double() * (pose - command), True


def touches(scene: Scene, poses: torch.Tensor) -> np.ndarray:
    return np.array([scene.clearances(pose) for pose in poses]) < TOUCHING


@pytest.mark.parametrize("name", OBJECTS)
def test_a_drawn_scene_lies_in_the_priors_and_starts_free_just_above_the_floor(name):
    for seed in range(20):
        scene = scene_of(name, seed)
        for entry, value in scene.theta.items():
            low, high = DEFAULT_BOUNDS[entry]
            assert low <= value <= high, entry
        floor_gap, wall_gap = scene.clearances(scene.start_pose)
        assert 0.0099 < floor_gap < 0.0201 and wall_gap > 0.0199
        assert scene.start_pose[0] <= 0


def test_draws_fill_the_priors_and_fixing_one_entry_leaves_the_others():
    scenes = [scene_of("mug", seed) for seed in range(200)]
    for entry in SCENE_NAMES:
        low, high = DEFAULT_BOUNDS[entry]
        unit = (np.array([scene.theta[entry] for scene in scenes]) - low) / (high - low)
        # Standard error of a uniform mean over 200 draws is 0.02: five of them.
        assert abs(unit.mean() - 0.5) < 0.1 and unit.min() < 0.05 and unit.max() > 0.95, entry
    fixed = scene_of("mug", 3, fixed={"friction": 0.25})
    assert fixed.theta == {**scenes[3].theta, "friction": 0.25}


def test_vertices_are_scaled_and_then_mounted():
    scene = scene_of(
        "mug", 0, fixed={"scale": 2.0, "mount_x": 0.01, "mount_z": -0.02, "mount_phi": math.pi / 2}
    )
    vertices = OUTLINES["mug"].vertices
    expected = np.stack((0.01 - 2 * vertices[:, 1], -0.02 + 2 * vertices[:, 0]), axis=1)
    assert np.allclose(scene.vertices_ee.numpy(), expected, atol=1e-12)


def test_a_start_pose_in_penetration_says_where_and_how_deep():
    with pytest.raises(ValueError, match=r"start pose .* mm inside the floor.*move it away"):
        scene_of("mug", 0, start_pose=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="inside the wall"):
        scene_of("mug", 0, start_pose=(0.2, 0.3, 0.0))
    with pytest.raises(ValueError, match="unknown scene parameter 'frictoin'"):
        scene_of("mug", 0, fixed={"frictoin": 0.1})
    with pytest.raises(ValueError, match="scale is -1"):
        scene_of("mug", 0, fixed={"scale": -1.0})


@pytest.mark.parametrize("policy", ["rich", "press_and_slide"])
@pytest.mark.parametrize("name", OBJECTS)
def test_exploration_feels_floor_and_wall_within_fifteen_steps(name, policy):
    for seed in range(2):
        scene = scene_of(name, seed)
        truth = make_truth(scene, "mujoco")
        motion = make_motion(policy, scene, 15, generator(seed + 10))
        recording = record(truth, scene, motion, 15, generator(seed + 20))
        touched = touches(scene, recording.true.poses[1:])
        assert touched.any(axis=0).all()
        assert recording.true.wrenches[:, :2].abs().max() < 10
        assert all(recording.settled)
        if policy == "rich":
            pressed = (touched[:, 0] & ~touched[:, 1], touched[:, 1] & ~touched[:, 0])
            assert all(rows.any() for rows in pressed)
            tilts = recording.true.commands[:, 2]
            assert tilts.max() > 0.05 and tilts.min() < -0.05


def test_exploration_sees_only_what_was_measured():
    """Two truths that answer alike get equal commands, whatever the scene behind them."""

    commands = []
    for name in ("mug", "book"):
        scene = replace(
            scene_of(name, 0, fixed={"wall_position": 0.5}),
            start_pose=torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64),
        )
        motion = make_motion("rich", scene, 12, generator(1))
        commands.append(record(FlatFloor(), scene, motion, 12, generator(2)).measured.commands)
    assert torch.equal(*commands)


@pytest.mark.parametrize("policy", ["rich", "press_and_slide"])
def test_commands_stay_within_the_force_limit_whatever_is_measured(policy):
    """Fuzzed wrenches: the command never asks for more than the limit on a blocked arm."""
    rng = np.random.default_rng(0)
    stiffness = torch.tensor([400.0, 250.0, 50.0], dtype=torch.float64)
    scene = scene_of("mug", 0)
    motion = make_motion(policy, scene, 60, generator(0))
    rows = np.array([[0.0, 0.1, 0.0]])
    wrenches = np.zeros((1, 3))
    for _ in range(60):
        history = History(*(torch.from_numpy(v) for v in (rows, rows, wrenches)), stiffness)
        command = motion.next_command(history)
        force = stiffness * (command - history.poses[-1])
        assert force[:2].abs().max() <= FORCE_LIMIT + 1e-9
        assert command[2].abs() <= LARGEST_TILT
        rows = np.vstack((rows, command.numpy() + rng.normal(0, 0.01, 3)))
        wrenches = np.vstack((wrenches, rng.normal(0, 4, 3)))


def test_test_trajectories_are_smooth_bounded_and_visit_all_modes():
    modes = set()
    for seed, name in enumerate(OBJECTS):
        scene = scene_of(name, seed)
        motion = make_motion("test", scene, 30, generator(seed))
        recording = record(
            make_truth(scene, "mujoco"), scene, motion, 30, generator(seed)
        )  # fmt: skip
        commands = recording.true.commands
        assert torch.equal(commands[0], scene.start_pose)
        assert commands[:, 2].abs().max() <= LARGEST_TILT
        assert torch.linalg.norm(commands.diff(dim=0)[:, :2], dim=1).max() < 0.1
        assert recording.true.wrenches[:, :2].abs().max() < 6
        touched = touches(scene, recording.true.poses[1:])
        assert touched.any(axis=0).all() and (~touched).all(axis=1).any()
        modes |= {tuple(row) for row in touched.tolist()}
    assert len(modes) == 4


def test_a_test_trajectory_has_as_many_commands_as_asked():
    scene = scene_of("mug", 0)
    for steps in (1, 3, 7, 30, 100):
        plan = planned_test(
            scene.vertices_ee, scene.floor_height, scene.wall_position, scene.start_pose, steps,
            generator(0), scene.stiffness,
        )  # fmt: skip
        assert plan.commands.shape == (steps + 1, 3)
    with pytest.raises(ValueError, match="steps is 0"):
        make_motion("test", scene, 0, generator(0))
    history = History(plan.commands, plan.commands, plan.commands, scene.stiffness)
    with pytest.raises(ValueError, match="the plan has 101 rows"):
        plan.next_command(history)


def test_a_plan_is_not_followed_from_where_it_does_not_begin():
    plan = PlannedMotion(torch.tensor([[0.0, 0.1, 0.0], [0.01, 0.1, 0.0]], dtype=torch.float64))

    def first(*start):
        rows = torch.tensor([start], dtype=torch.float64)
        return plan.next_command(History(rows, rows, rows, torch.ones(3).double()))

    assert first(0.004, 0.096, 0.04).tolist() == [0.01, 0.1, 0.0]
    for start in ((0.006, 0.1, 0.0), (0.0, 0.094, 0.0), (0.0, 0.1, -0.06)):
        with pytest.raises(RobotError, match="but the plan begins at .*put the hand there"):
            first(*start)


def test_the_noise_of_an_episode_is_what_its_yaml_says():
    scene = scene_of("mug", 1)
    rest = PlannedMotion(scene.start_pose.expand(301, 3).clone())
    std = torch.tensor([1e-4, 2e-4, 5e-4, 0.3, 0.2, 0.02], dtype=torch.float64)
    recording = record(FlatFloor(), scene, rest, 300, generator(0), std)
    measured = torch.cat((recording.measured.poses, recording.measured.wrenches), dim=1)
    true = torch.cat((recording.true.poses, recording.true.wrenches), dim=1)
    ratio = (measured - true).std(dim=0) / std
    # Standard error of a standard deviation over 301 rows is 4.1 %: five of them.
    assert (ratio - 1).abs().max() < 0.2
    normalised = (measured - true) / std
    correlation = torch.corrcoef(normalised.T) - torch.eye(6, dtype=torch.float64)
    assert correlation.abs().max() < 0.3  # five standard errors of 1 / sqrt(301)
    assert recording.true.sensor_std.abs().max() == 0


def test_the_same_seed_gives_the_same_recording_and_another_seed_another():
    scene = scene_of("mug", 2)
    truth = make_truth(scene, "mujoco")
    runs = [
        record(truth, scene, make_motion("rich", scene, 6, generator(s)), 6, generator(s + 9))
        for s in (0, 0, 1)
    ]
    assert torch.equal(runs[0].measured.wrenches, runs[1].measured.wrenches)
    assert not torch.equal(runs[0].measured.wrenches, runs[2].measured.wrenches)


def test_a_recording_reads_back_with_its_truth_and_raises_no_warning(tmp_path):
    scene = scene_of("mug", 4)
    motion = make_motion("rich", scene, 15, generator(4))
    recording = record(make_truth(scene, "mujoco"), scene, motion, 15, generator(4))
    path = write_recording(recording, scene, tmp_path / "mug.v2")
    episode = read_episode(tmp_path)
    assert torch.equal(episode.wrenches, recording.measured.wrenches)
    assert check_episode(episode) == []
    true, read_scene = read_truth(path)
    assert torch.equal(true.poses, recording.true.poses)
    assert read_scene.theta == scene.theta
    assert torch.equal(read_scene.vertices_ee, scene.vertices_ee)
    with pytest.raises(EpisodeError, match="exists already"):
        write_recording(recording, scene, path)
    check_truth(episode, true)
    for values, told in (
        ({"poses": true.poses + torch.tensor([0.0, 0.004, 0.0])}, "column z: differs by -0.0"),
        ({"wrenches": true.wrenches.flip(0)}, "from the truth beside it, and its noise is 0.3"),
        ({"commands": true.commands.flip(0)}, "has other commands than the truth"),
    ):
        with pytest.raises(EpisodeError, match=told):
            check_truth(episode, replace(true, **values))
    scene_path = tmp_path / "mug.v2.truth.yaml"
    scene_path.write_text("theta: {scale: 1}")
    with pytest.raises(EpisodeError, match="not a truth file"):
        read_truth(path)
    scene_path.unlink()
    with pytest.raises(EpisodeError, match="only simulated episodes"):
        read_truth(path)


@pytest.fixture(scope="module")
def simulate_command():
    """The script's door with its arguments: returns the exit code."""
    spec = importlib.util.spec_from_file_location("simulate_script", SIMULATE)
    script = sys.modules["simulate_script"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    def call(*arguments: str) -> int:
        with pytest.raises(SystemExit) as stopped:
            script.run(script.simulate, script.Simulation, arguments)
        return stopped.value.code

    yield call
    del sys.modules["simulate_script"]


def test_the_command_makes_several_episodes_of_one_scene(simulate_command, tmp_path, capsys):
    code = simulate_command(
        "--outline", "mug", "--policy", "test", "--episodes", "2", "--steps", "4",
        "--friction", "0.4", "--seed", "3", "--out", str(tmp_path / "a"),
    )  # fmt: skip
    printed = capsys.readouterr()
    assert code == 0, printed.err
    assert printed.out.count("4 steps") == 2
    first, second = (read_truth(tmp_path / "a" / f"test_{i}.csv") for i in (0, 1))
    assert first[1].theta == second[1].theta
    assert first[1].friction == 0.4
    assert not torch.equal(first[0].commands, second[0].commands)
    made_by = yaml.safe_load((tmp_path / "a" / "test_0.truth.yaml").read_text())["made_by"]
    assert made_by["config"]["friction"] == 0.4 and "packages" in made_by
    before = {path: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    code = simulate_command(
        "--outline", "mug", "--policy", "test", "--steps", "4", "--seed", "3", "--episodes", "3",
        "--out", str(tmp_path / "a"),
    )  # fmt: skip
    assert code == 2 and "exists already" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


def test_both_truths_answer_the_same_first_steps_alike(simulate_command, tmp_path):
    """Light pressing from free space: within 0.2 mm and 0.02 N of each other."""
    for truth in ("mujoco", "quasistatic"):
        code = simulate_command(
            "--outline", "soup_can", "--truth", truth, "--policy", "test", "--steps", "6",
            "--seed", "1", "--name", truth, "--out", str(tmp_path),
        )  # fmt: skip
        assert code == 0
    first, second = (
        read_truth(tmp_path / f"{truth}.csv")[0] for truth in ("mujoco", "quasistatic")
    )
    assert torch.equal(first.commands, second.commands)
    assert (first.poses - second.poses)[:, :2].abs().max() < 2e-4
    assert (first.wrenches - second.wrenches)[:, :2].abs().max() < 2e-2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--outline", "mugg"), "did you mean mug"),
        (("--outline", "none.csv"), "none.csv"),
        (("--outline", "mug", "--steps", "0"), "steps is 0"),
        (("--outline", "mug", "--start", "0", "0", "0"), "inside the floor"),
        (("--outline", "mug", "--start", "0", "0"), "expected x, z, phi"),
        (("--outline", "mug", "--noise-force", "-1"), "noise_force is -1"),
    ],
)
def test_a_bad_request_gets_one_line_and_leaves_nothing(
    arguments, message, simulate_command, tmp_path, capsys
):
    assert simulate_command(*arguments, "--out", str(tmp_path / "out")) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_help_is_quick():
    times = []
    for _ in range(3):
        start = time.perf_counter()
        result = subprocess.run(
            [sys.executable, str(SIMULATE), "--help"],
            capture_output=True, text=True,
            env={"PYTHONPATH": str(SIMULATE.parents[1]), "PATH": ""},
        )  # fmt: skip
        times.append(time.perf_counter() - start)
        assert result.returncode == 0 and "--outline" in result.stdout
    loaded = subprocess.run(
        [sys.executable, "-X", "importtime", str(SIMULATE), "--help"],
        capture_output=True, text=True, env={"PYTHONPATH": str(SIMULATE.parents[1]), "PATH": ""},
    ).stderr  # fmt: skip
    assert " torch" not in loaded and " mujoco" not in loaded and " shapely" not in loaded
    assert min(times) < 1.5  # 0.3 s on an idle machine; the imports above are the real check
