"""An exploration into a run folder: the same files as an estimation, and the episode itself."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from tpcd.belief import EstimatorSettings
from tpcd.belief.belief import Belief
from tpcd.belief.state import EstimatorState, load_state
from tpcd.belief.storage import load_belief
from tpcd.commands.drawing import KnownTruth
from tpcd.commands.estimation import Closing, EstimationRun
from tpcd.commands.exploring_options import ExploringOptions
from tpcd.commands.kept_model import check_kept_model, keep_model, model_of
from tpcd.commands.summary import parameter_rows
from tpcd.data.episode import Episode, read_episode, write_together
from tpcd.errors import RobotError
from tpcd.exploration import Estimator, ExplorationStep, explore
from tpcd.policies import Limits
from tpcd.policies.active import Task
from tpcd.policies.protocol import Policy
from tpcd.predict import ContactPredictor
from tpcd.results import RESULTS_FILE, continue_run, format_table, run_folder, write_results
from tpcd.robot.protocol import Robot
from tpcd.shape.checkpoint import load_prior

EPISODE_NAME = "explore"
MAY_CHANGE = ("model", "out", "resume", "overwrite", "steps", "stop_gain", "stop_error")
"""Options with which a stopped run may go on in another way."""


@dataclass(frozen=True)
class Stage:
    """Who moves, who decides where to, and what is kept of it."""

    robot: Robot
    policy: Policy
    contents: Callable[[Episode], dict[Path, bytes | None]]
    """What the files of the rows so far hold, for `write_together`."""
    truth: KnownTruth | None = None
    """What a simulation knows; printed and drawn beside the belief."""


def explore_in_folder(
    options: ExploringOptions,
    command: str,
    stage: Callable[[Path, Limits, Task | None], Stage],
    resumable: str,
    may_change: tuple[str, ...] = MAY_CHANGE,
) -> None:
    """Explore with any robot into a run folder, or go on there, and print what was learnt.

    `stage` is given the folder, the limits and the task; `resumable` names the file with which a
    stopped run can go on. Raises `RunError` for folders that cannot be used, `RobotError` where
    the robot had to stop.
    """
    model, shape = model_of(options.model), load_prior(options.prior)
    task = None if options.task is None else _task(options.task)
    limits = Limits(
        options.force_limit,
        options.step_limit,
        options.workspace_low,
        options.workspace_high,
        options.force_probability,
    )
    if options.resume:
        check_kept_model(model, options.out)
        opened = nullcontext(continue_run(options.out, options, may_change))
    else:
        opened = run_folder(options.out, command, options, options.overwrite, resumable=resumable)
    with opened as folder:
        keep_model(model, folder, options.model)
        episode, belief, state = None, None, None
        path = folder / f"{EPISODE_NAME}.csv"
        if options.resume and path.is_file():
            episode = read_episode(path)
            state = load_state(folder, episode, growing=True)
            belief = None if state is None else load_belief(folder)
        done = 0 if state is None else state.index
        if done >= options.steps and (folder / RESULTS_FILE).is_file():
            raise ValueError(f"{options.out} has all of its {options.steps} moves; raise --steps")
        on_stage = stage(folder, limits, task)
        settings = EstimatorSettings(step=model.step, effects=model.informed)
        estimator = Estimator(shape, options.estimator, settings)
        steps = explore(
            on_stage.robot,
            on_stage.policy,
            estimator,
            options.seed,
            episode,
            belief,
            state,
            lambda rows: write_together(on_stage.contents(rows)),
            options.stop_gain or 0.0,
        )
        try:
            belief, episode, reason = run_exploration(
                steps,
                Stopping(options.steps, options.stop_error),
                options.prior,
                folder,
                episode,
                task,
                on_stage.truth,
                state,
                estimator.closing_step,
            )
        except RobotError as error:
            hint = f"; {options.out} goes on with --resume"
            kept = error.resumable and (folder / resumable).is_file()
            raise RobotError(f"{error}{hint if kept else ''}") from error
        except KeyboardInterrupt as stop:
            on_stage.robot.stop()
            where = getattr(on_stage.robot, "at_rest", None)
            raise KeyboardInterrupt(*([where] if where else [])) from stop
        finally:
            try:
                on_stage.robot.stop()
            finally:
                on_stage.robot.close()
        _finish(options, folder, belief, episode, reason, on_stage.truth)


def _finish(
    options: ExploringOptions,
    folder: Path,
    belief: Belief,
    episode: Episode,
    reason: str,
    truth: KnownTruth | None,
) -> None:
    """Print what was learnt, and end the run."""
    from torch.utils.tensorboard import SummaryWriter

    table = parameter_rows(belief)
    if truth is not None:
        for row in table:
            row["true"] = truth.scene.get(row["parameter"])
    text = format_table(table)
    print(text)
    with SummaryWriter(folder / "tensorboard") as writer:
        writer.add_text("table", f"```\n{text}\n```")
    moves = len(episode) - 1
    write_results(folder, table, seeds=[options.seed], moves=moves, stopped_because=reason)
    print(f"\n{moves} moves: {reason}", file=sys.stderr)
    print(
        f"results in {options.out}; next: python scripts/predict.py {options.out} EPISODE"
        " --out FILE.csv"
    )


def _task(path: Path) -> Task:
    episode = read_episode(path)
    return Task(episode.poses[:-1], episode.commands[1:], episode.commands[:-1])


@dataclass(frozen=True)
class Stopping:
    """When an exploration has seen enough."""

    steps: int
    """Moves at most."""
    position_error: float | None = None
    """Stop once the belief expects its predictions of the task to be this good [m]."""

    def reason(self, step: ExplorationStep, task: Task | None) -> str | None:
        """Why to stop after a step; None to go on."""
        if self.position_error is not None and task is not None:
            error = task.predicted_error(ContactPredictor(step.estimation.belief))[:2].max()
            if float(error) <= self.position_error:
                return f"the task's poses are expected within {1e3 * float(error):.2f} mm"
        if len(step.episode) > self.steps:
            return f"all {self.steps} moves are made"
        return None


def run_exploration(
    steps: Iterator[ExplorationStep],
    stopping: Stopping,
    prior_name: str,
    folder: Path,
    episode: Episode | None = None,
    task: Task | None = None,
    truth: KnownTruth | None = None,
    state: EstimatorState | None = None,
    closing: Closing | None = None,
    show_progress: bool = True,
) -> tuple[Belief, Episode, str]:
    """Explore until it is enough, saving as it goes; returns belief, episode and why it ended.

    The steps up to the `state` of an earlier run in the folder, with the rows `episode`, are
    kept, and `steps` come after them; where they are all that was asked for, only what ends a
    run is missing.
    """
    with EstimationRun(folder, prior_name, stopping.steps, state, show_progress, closing) as run:
        if episode is not None and state is not None and state.index >= stopping.steps:
            return run.finish(episode, truth), episode, f"all {stopping.steps} moves are made"
        for step in steps:
            choice, episode = step.choice, step.episode
            if not step.settled:
                run.bar.write(
                    f"warning: the arm did not stand still after move {len(episode) - 1}",
                    file=sys.stderr,
                )
            x, z, angle = choice.command.tolist()
            if choice.asked is not None:
                run.bar.write(
                    f"warning: limits drew the command of move {len(episode) - 1} back from"
                    f" ({', '.join(f'{value:.3f}' for value in choice.asked.tolist())}) to"
                    f" ({x:.3f}, {z:.3f}, {angle:.3f}) [m, m, rad]",
                    file=sys.stderr,
                )
            lead = f"u ({1e3 * x:.0f}, {1e3 * z:.0f} mm, {1e3 * angle:.0f} mrad), "
            if choice.gain is not None:
                lead += f"gain {choice.gain:.1f}, chosen in {step.choosing_seconds:.1f} s, "
            further = {
                "gain": choice.gain,
                "choosing_seconds": step.choosing_seconds,
                "excess_probability": choice.excess_probability,
                "settled": step.settled,
                "command": choice.command.tolist(),
            }
            run.add(step.estimation, step.episode, further, lead)
            reason = stopping.reason(step, task)
            if reason is not None:
                return run.finish(step.episode, truth), step.episode, reason
        if episode is None:
            raise ValueError("no move promises as much as was asked for; ask for less gain")
        return run.finish(episode, truth), episode, "no move promises as much as was asked for"
