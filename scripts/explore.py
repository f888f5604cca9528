"""Explore an unknown object: choose each move for what it teaches, and learn from it.

python scripts/explore.py --outline mug --out runs/explored
python scripts/explore.py --outline mug --policy expert --out runs/expert
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from tpcd.data.episode import Episode
    from tpcd.policies.active import Task

SCENE_STREAM = 0
"""The stream of scripts/simulate.py, so that equal seeds mean equal scenes."""


@dataclass(frozen=True)
class Exploration:
    """Settings of the command; SI units."""

    outline: str
    """Outline that plays the unknown object: a built-in or YCB name, or a file."""
    out: Path
    """Folder for the results; a stopped run in it goes on with --resume."""
    prior: str = "ycb-rich"
    """Shape prior: a checkpoint folder, or the name of a shipped one."""
    policy: Literal["active", "lookahead", "grid", "random", "expert", "rich"] = "active"
    """active: the most informative command within reach; lookahead: the same, two commands deep;
    grid: the best of the paper's 27; random: the paper's basic trajectory with noise; expert: one
    trajectory made with the true wall in view; rich: a script that feels its way."""
    steps: int = 15
    """Moves at most."""
    stop_gain: float | None = None
    """Stop before a command that promises less than this [nat; with --task: mean square of the
    tolerance 1 mm, 1 mm, 5 mrad]; a goal n steps away counts over the root of n."""
    task: Path | None = None
    """Episode whose motions are to be predicted: learn what they depend on."""
    stop_error: float | None = None
    """Stop once the task's poses are expected to be predicted this well [m]."""
    force_limit: float = 8.0
    """Largest force on an axis [N]."""
    force_probability: float = 0.05
    """A command that exceeds it with more than this probability is not taken."""
    step_limit: tuple[float, float, float] = (0.08, 0.08, 0.3)
    """Farthest a command may be from the last pose, on each axis [m, m, rad]."""
    workspace_low: tuple[float, float, float] = (-1.0, -1.0, -0.15)
    """Lower corner of the workspace of commands [m, m, rad]."""
    workspace_high: tuple[float, float, float] = (1.0, 1.0, 0.15)
    """Upper corner of the workspace [m, m, rad]."""
    model: Path | None = None
    """Model file with effects to estimate too, such as diagnose writes (docs/effects.md)."""
    estimator: Literal["default", "paper"] = "default"
    """`paper` is the particle filter of arXiv 2409.17470 for comparison."""
    truth: Literal["quasistatic", "mujoco"] = "mujoco"
    """Who decides what happens: the project's own model, or MuJoCo independent of it."""
    seed: int = 0
    """Seed of scene, noise, policy and sampler."""
    resume: bool = False
    """Go on with a run in the folder that was stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            least={"steps": 1},
            above={"force_limit": 0.0, "stop_gain": 0.0, "stop_error": 0.0},
        )
        if self.stop_error is not None and self.task is None:
            raise ValueError("stop_error needs a task to predict; name an episode with --task")
        if self.model is not None and self.estimator == "paper":
            raise ValueError("the estimator paper has a model of its own; leave --model out")
        weighs = self.policy in ("active", "lookahead", "grid")
        if self.stop_gain is not None and not weighs:
            raise ValueError(f"stop_gain needs a policy that weighs commands, not {self.policy}")
        if self.task is not None and self.stop_error is None and self.policy != "active":
            raise ValueError(
                f"a task changes nothing with {self.policy}; add stop_error, or use active"
            )


def explore_object(config: Exploration) -> None:
    """Explore an object in simulation and write belief and episode to a run folder."""
    import sys
    from contextlib import nullcontext

    import torch
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.belief import EstimatorSettings
    from tpcd.belief.state import STATE_FILE, load_state
    from tpcd.belief.storage import load_belief
    from tpcd.commands.estimation import KnownTruth, parameter_rows
    from tpcd.commands.exploring import EPISODE_NAME, Stopping, run_exploration
    from tpcd.commands.kept_model import check_kept_model, keep_model, model_of
    from tpcd.data.episode import read_episode, write_together
    from tpcd.exploration import Estimator, explore
    from tpcd.policies import Limits, make_policy
    from tpcd.random import stream
    from tpcd.results import RESULTS_FILE, continue_run, format_table, run_folder, write_results
    from tpcd.robot import SimulatedRobot
    from tpcd.shape.checkpoint import load_prior
    from tpcd.shape.named import find_outline
    from tpcd.truth.recording import recording_contents
    from tpcd.truth.scene import draw_scene, make_truth

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    outline = find_outline(config.outline)
    scene = draw_scene(outline.name, outline.vertices, stream(config.seed, SCENE_STREAM))
    model = model_of(config.model)
    shape = load_prior(config.prior)
    task = None if config.task is None else _task(config.task)
    limits = Limits(
        config.force_limit,
        config.step_limit,
        config.workspace_low,
        config.workspace_high,
        config.force_probability,
    )
    notes = f"explored, truth {config.truth}, policy {config.policy}, seed {config.seed}"
    robot = SimulatedRobot(make_truth(scene, config.truth), scene, config.seed, notes=notes)
    policy = make_policy(config.policy, limits, scene, config.seed, task)
    if config.resume:
        check_kept_model(model, config.out)
        free = ("model", "out", "resume", "overwrite", "steps", "stop_gain", "stop_error")
        opened = nullcontext(continue_run(config.out, config, free))
    else:
        opened = run_folder(
            config.out, "scripts/explore.py", config, config.overwrite, resumable=STATE_FILE
        )
    with opened as folder:
        keep_model(model, folder, config.model)
        path, episode, belief, state = folder / f"{EPISODE_NAME}.csv", None, None, None
        if config.resume and path.is_file():
            episode = read_episode(path)
            state = load_state(folder, episode, growing=True)
            belief = None if state is None else load_belief(folder)
        done = 0 if state is None else state.index
        if done >= config.steps and (folder / RESULTS_FILE).is_file():
            raise ValueError(f"{config.out} has all of its {config.steps} moves; raise --steps")

        def save(rows: Episode) -> None:
            write_together(recording_contents(robot.recording(rows), scene, path))

        settings = EstimatorSettings(step=model.step, effects=model.effects)
        estimator = Estimator(shape, config.estimator, settings)
        steps = explore(
            robot, policy, estimator, config.seed, episode, belief, state, save,
            config.stop_gain or 0.0,
        )  # fmt: skip
        try:
            belief, episode, reason = run_exploration(
                steps,
                Stopping(config.steps, config.stop_error),
                config.prior,
                folder,
                episode,
                task,
                KnownTruth(scene.vertices_ee, scene.theta),
                done,
            )
        finally:
            robot.stop()
            robot.close()
        table = parameter_rows(belief)
        for row in table:
            row["true"] = scene.theta.get(row["parameter"])
        text = format_table(table)
        print(text)
        with SummaryWriter(folder / "tensorboard") as writer:
            writer.add_text("table", f"```\n{text}\n```")
        write_results(
            folder, table, seeds=[config.seed], moves=len(episode) - 1, stopped_because=reason
        )
    print(f"\n{len(episode) - 1} moves: {reason}", file=sys.stderr)
    print(
        f"results in {config.out}; next: python scripts/predict.py {config.out} EPISODE"
        " --out FILE.csv"
    )


def _task(path: Path) -> Task:
    from tpcd.data import read_episode
    from tpcd.policies.active import Task

    episode = read_episode(path)
    return Task(episode.poses[:-1], episode.commands[1:], episode.commands[:-1])


if __name__ == "__main__":
    run(explore_object, Exploration)
