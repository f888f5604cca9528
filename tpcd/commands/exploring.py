"""An exploration into a run folder: the same files as an estimation, and the episode itself."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

from tqdm import tqdm

from tpcd.belief import EstimatorSettings
from tpcd.belief.belief import Belief
from tpcd.belief.state import load_state
from tpcd.belief.storage import load_belief
from tpcd.cli_messages import system_problem
from tpcd.commands.drawing import KnownTruth
from tpcd.commands.exploration_run import Kept, Stopping, run_exploration
from tpcd.commands.exploring_options import ExploringOptions
from tpcd.commands.kept_model import check_kept_model, keep_model, model_of
from tpcd.commands.plausibility import keep_doubts, keep_rows
from tpcd.commands.summary import parameter_rows
from tpcd.data.doubts import doubts_told
from tpcd.data.episode import Episode
from tpcd.data.files import read_episode, write_together
from tpcd.errors import RobotError
from tpcd.exploration import Estimator, explore
from tpcd.policies import Limits
from tpcd.policies.active import Task
from tpcd.policies.protocol import Policy
from tpcd.quality.finding import Finding
from tpcd.results import RESULTS_FILE, format_table, resumed_run, run_folder, write_results
from tpcd.robot.protocol import Robot, stopped_first
from tpcd.shape.checkpoint import load_prior

EPISODE_NAME = "explore"
MAY_CHANGE = ("model", "out", "steps", "stop_gain", "stop_error")
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


class WrittenRows:
    """The episode of an exploration as it is written, with what is doubtful of it. As a context it
    tells and writes at the end what the last stop of the robot has brought to light."""

    def __init__(self, path: Path, stage: Stage, before: tuple[Finding, ...]) -> None:
        """`before` are the doubts of the rows that a run goes on after."""
        self._path, self._stage, self._before = path, stage, before
        self._rows: Episode | None = None
        self._told: set[str] = set()
        self._tell(before)

    def write(self, rows: Episode) -> None:
        """Write all rows so far. Doubts that are new are told first, those that grow at the end."""
        doubts = (*self._before, *self._stage.robot.doubts())
        self._tell(doubt for doubt in doubts if not self._told.intersection(doubt.channels))
        self._keep(replace(rows, doubts=doubts, path=self._path))

    def __enter__(self) -> WrittenRows:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        doubts = (*self._before, *self._stage.robot.doubts())
        self._tell(doubts)
        if self._rows is not None and doubts != self._rows.doubts:
            # What failed first is what ends the run.
            with nullcontext() if kind is None else suppress(Exception):
                self._keep(replace(self._rows, doubts=doubts))

    def _keep(self, rows: Episode) -> None:
        self._rows = rows
        write_together(self._stage.contents(rows))
        keep_doubts(rows, self._path.parent)

    def _tell(self, doubts: Iterable[Finding]) -> None:
        for doubt in doubts:
            if str(doubt) not in self._told:
                tqdm.write(f"warning: {doubt.weight.value}: {doubt}", file=sys.stderr)
                self._told.update((str(doubt), *doubt.channels))


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
        opened = resumed_run(options.out, options, may_change)
    else:
        opened = run_folder(options.out, command, options, options.overwrite, resumable=resumable)
    with opened as folder:
        keep_model(model, folder, options.model)
        settings = EstimatorSettings(step=model.step, effects=model.informed, shape=model.shape)
        estimator = Estimator(shape, options.estimator, settings)
        kept = _kept(folder, estimator, options.prior) if options.resume else Kept()
        before = () if kept.episode is None else kept.episode.doubts
        done = 0 if kept.state is None else kept.state.index
        if done >= options.steps and (folder / RESULTS_FILE).is_file():
            raise ValueError(f"{options.out} has all of its {options.steps} moves; raise --steps")
        on_stage = stage(folder, limits, task)
        rows = WrittenRows(folder / f"{EPISODE_NAME}.csv", on_stage, before)
        steps = explore(
            on_stage.robot,
            on_stage.policy,
            estimator,
            options.seed,
            kept.episode,
            kept.belief,
            kept.state,
            rows.write,
            options.stop_gain or 0.0,
        )
        robot = on_stage.robot
        try:
            with rows, closing(robot), stopped_first(robot.stop):
                belief, episode, reason = run_exploration(
                    steps,
                    Stopping(options.steps, options.stop_error),
                    options.prior,
                    folder,
                    kept,
                    task,
                    on_stage.truth,
                    estimator.closing,
                    robot.stop,
                )
        except (RobotError, OSError) as error:
            hint = f"; {options.out} goes on with --resume"
            goes_on = getattr(error, "resumable", True) and (folder / resumable).is_file()
            raise RobotError(f"{_told(error, robot)}{hint if goes_on else ''}") from error
        except KeyboardInterrupt as stop:
            where = getattr(robot, "at_rest", None)
            raise KeyboardInterrupt(*([where] if where else [])) from stop
        keep_rows([episode], folder)
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
        f"results in {options.out}; next: python scripts/predict.py {quote(str(options.out))}"
        " EPISODE --out FILE.csv"
    )


def _told(error: Exception, robot: Robot) -> str:
    """What failed, and how the arm was left."""
    if isinstance(error, OSError):
        where = getattr(robot, "at_rest", None)
        return system_problem(error) + (f"; {where}" if where else "")
    return str(error)


def _kept(folder: Path, estimator: Estimator, prior: str) -> Kept:
    path = folder / f"{EPISODE_NAME}.csv"
    if not path.is_file():
        return Kept()
    episode = read_episode(path)
    state = load_state(folder, episode, prior, growing=True)
    if state is None:
        return Kept(episode)
    return Kept(episode, estimator.held(episode, state) or load_belief(folder), state)


def _task(path: Path) -> Task:
    episode = read_episode(path)
    told = doubts_told(episode.doubts, episode.path)
    if told:
        print(f"warning: {told}", file=sys.stderr)
    rows = episode.poses[:-1], episode.commands[1:], episode.commands[:-1]
    return Task(*rows, stiffness=episode.stiffness)
