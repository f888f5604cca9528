"""Explore an unknown object: choose each move for what it teaches, and learn from it.

python scripts/explore.py --outline mug --out runs/explored
python scripts/explore.py --outline mug --policy expert --out runs/expert
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tpcd.cli import run
from tpcd.commands.exploring_options import ExploringOptions

if TYPE_CHECKING:
    from tpcd.commands.exploring import Stage
    from tpcd.policies import Limits
    from tpcd.policies.active import Task

SCENE_STREAM = 0
"""The stream of scripts/simulate.py, so that equal seeds mean equal scenes."""


@dataclass(frozen=True, kw_only=True)
class Exploration(ExploringOptions):
    """Settings of the command; SI units."""

    outline: str
    """Outline that plays the unknown object: a built-in or YCB name, or a file."""
    policy: Literal["active", "lookahead", "grid", "random", "expert", "rich"] = "active"
    """active: the most informative command within reach; lookahead: the same, two commands deep;
    grid: the best of the paper's 27; random: the paper's basic trajectory with noise; expert: one
    trajectory made with the true wall in view; rich: a script that feels its way."""
    truth: Literal["quasistatic", "mujoco"] = "mujoco"
    """Who decides what happens: the project's own model, or MuJoCo independent of it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_policy(self.policy)


def explore_object(config: Exploration) -> None:
    """Explore an object in simulation and write belief and episode to a run folder."""
    import torch

    from tpcd.belief.state import STATE_FILE
    from tpcd.commands.drawing import KnownTruth
    from tpcd.commands.exploring import EPISODE_NAME, Stage, explore_in_folder
    from tpcd.policies import make_policy
    from tpcd.random import stream
    from tpcd.robot.simulated import SimulatedRobot
    from tpcd.shape.named import find_outline
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import recording_contents
    from tpcd.truth.scene import draw_scene

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    outline = find_outline(config.outline)
    scene = draw_scene(outline.name, outline.vertices, stream(config.seed, SCENE_STREAM))
    notes = f"explored, truth {config.truth}, policy {config.policy}, seed {config.seed}"

    def stage(folder: Path, limits: Limits, task: Task | None) -> Stage:
        robot = SimulatedRobot(make_truth(scene, config.truth), scene, config.seed, notes=notes)
        path = folder / f"{EPISODE_NAME}.csv"
        return Stage(
            robot,
            make_policy(config.policy, limits, scene, config.seed, task),
            lambda rows: recording_contents(robot.recording(rows), scene, path),
            KnownTruth(scene.vertices_ee, scene.theta),
        )

    explore_in_folder(config, "scripts/explore.py", stage, STATE_FILE)


if __name__ == "__main__":
    run(explore_object, Exploration)
