"""The quasi-static step against MuJoCo, which shares no code with it.

Episodes of exploration and of test trajectories are simulated by MuJoCo; every transition is
then predicted from where MuJoCo really was. Force and position are judged by x and z together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from contact_scenes import OUTLINES, make_scene

from tpcd.planar import wrap_angle
from tpcd.shape.builtin import make_entry
from tpcd.shape.household import ENTRIES
from tpcd.simulator import StepSettings, simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

MEAN_FORCE = 0.02
"""Largest mean error of a force [N]."""
MEAN_POSE = 2e-4
"""Largest mean error of a position [m]."""
MEAN_TORQUE = 0.01
"""Largest mean error of the torque [N·m]: half of the usual sensor noise."""
MEAN_ANGLE = 2e-4
"""Largest mean error of the angle [rad], which has that torque at 50 N·m/rad."""
SETTINGS = StepSettings(friction="coulomb", substeps=10, follow_path=True)


@dataclass(frozen=True)
class Comparison:
    """Errors of n transitions: force (n, 2) [N], position (n, 2) [m], torque (n) [N·m], angle (n)
    [rad]."""

    force: torch.Tensor
    position: torch.Tensor
    torque: torch.Tensor
    angle: torch.Tensor
    names: tuple[str, ...]

    @property
    def report(self) -> str:
        """One line of figures."""
        force, position = self.force.abs(), self.position.abs()
        worst = int(force.amax(-1).argmax())
        return (
            f"{len(force)} transitions: force {force.mean():.4f} N (99 %: "
            f"{force.flatten().quantile(0.99):.3f}, worst {force.max():.3f} on "
            f"{self.names[worst]}), position {position.mean() * 1e3:.4f} mm, "
            f"torque {self.torque.abs().mean():.5f} N·m, "
            f"angle {self.angle.abs().mean() * 1e3:.4f} mrad"
        )


def compare(
    outlines: dict[str, np.ndarray],
    steps: int,
    policies: tuple[str, ...],
    settings: StepSettings = SETTINGS,
) -> Comparison:
    """Record one MuJoCo episode for each outline and policy and predict its transitions."""
    parts, names = [], []
    for k, (name, vertices) in enumerate(outlines.items()):
        for policy in policies:
            generator = torch.Generator().manual_seed(100 + k)
            scene = draw_scene(name, vertices, generator)
            motion = make_motion(policy, scene, steps, generator)
            truth = make_truth(scene, "mujoco")
            recording = record(truth, scene, motion, steps, generator, torch.zeros(6).double())
            assert all(recording.settled)
            episode = recording.true
            transition = simulate_step(
                make_scene(
                    scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position
                ),
                episode.poses[:-1],
                episode.commands[1:],
                episode.stiffness,
                settings,
                previous=episode.commands[:-1],
            )
            wrench = transition.wrench - episode.wrenches[1:]
            pose = transition.pose - episode.poses[1:]
            angle = wrap_angle(pose[:, 2:])
            parts.append(torch.cat((wrench[:, :2], pose[:, :2], wrench[:, 2:], angle), dim=-1))
            names += [f"{name} ({policy} {row})" for row in range(1, steps + 1)]
    errors = torch.cat(parts)
    return Comparison(errors[:, :2], errors[:, 2:4], errors[:, 4], errors[:, 5], tuple(names))


def builtin(count: int) -> dict[str, np.ndarray]:
    return {name: make_entry(name, ENTRIES[name]).vertices for name in OUTLINES[:count]}


def check(comparison: Comparison) -> None:
    print(comparison.report)
    assert float(comparison.force.abs().mean()) <= MEAN_FORCE, comparison.report
    assert float(comparison.position.abs().mean()) <= MEAN_POSE, comparison.report
    assert float(comparison.torque.abs().mean()) <= MEAN_TORQUE, comparison.report
    assert float(comparison.angle.abs().mean()) <= MEAN_ANGLE, comparison.report


def test_transitions_of_test_trajectories_end_where_mujoco_ends():
    """A few transitions; the slow tests hold the model to the full numbers."""
    comparison = compare(builtin(3), 10, ("test",))
    check(comparison)


@pytest.mark.slow
def test_two_hundred_transitions_on_ten_outlines_end_where_mujoco_ends():
    comparison = compare(builtin(12), 10, ("rich", "test"))
    assert len(comparison.force) >= 200
    check(comparison)


@pytest.mark.slow
def test_transitions_of_ycb_outlines_end_where_mujoco_ends():
    from tpcd.shape.ycb import load_ycb, ycb_folder

    if ycb_folder() is None:
        pytest.skip("needs the YCB outlines; see scripts/fetch_ycb.py")
    outlines = load_ycb()
    chosen = {name: outlines[name].vertices for name in list(outlines)[:10]}
    check(compare(chosen, 10, ("rich", "test")))
