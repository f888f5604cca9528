"""The moves of an exploration into a run folder, until there is reason to stop."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tpcd.belief.belief import Belief
from tpcd.belief.state import EstimatorState
from tpcd.commands.drawing import KnownTruth
from tpcd.commands.estimation import EstimationRun
from tpcd.data.episode import Episode
from tpcd.exploration import Closing, ExplorationStep
from tpcd.policies.active import Task
from tpcd.predict import ContactPredictor
from tpcd.robot.protocol import stopped_first


@dataclass(frozen=True)
class Kept:
    """What an earlier run in a folder has left; nothing where there was none."""

    episode: Episode | None = None
    belief: Belief | None = None
    """After the last step that was learnt from, without the closing draws."""
    state: EstimatorState | None = None


@dataclass(frozen=True)
class Stopping:
    """When an exploration has seen enough."""

    steps: int
    """Moves at most."""
    position_error: float | None = None
    """Stop once the belief expects its predictions of the task to be this good [m]."""

    def reason(self, belief: Belief, moves: int, task: Task | None) -> str | None:
        """Why to stop after so many moves; None to go on."""
        if self.position_error is not None and task is not None:
            error = expected_error(belief, task)
            if error <= self.position_error:
                return f"the task's poses are expected within {1e3 * error:.2f} mm"
        if moves >= self.steps:
            return f"all {self.steps} moves are made"
        return None

    def closed_reason(self, reason: str, belief: Belief, task: Task | None) -> str:
        """The reason, with what the belief from the closing draws says of the error."""
        if self.position_error is None or task is None:
            return reason
        return f"{reason}; with the closing draws {1e3 * expected_error(belief, task):.2f} mm"


def expected_error(belief: Belief, task: Task) -> float:
    """Larger one of the expected errors of x and z over a task [m]."""
    return float(task.predicted_error(ContactPredictor(belief))[:2].max())


def run_exploration(
    steps: Iterator[ExplorationStep],
    stopping: Stopping,
    prior_name: str,
    folder: Path,
    kept: Kept | None = None,
    task: Task | None = None,
    truth: KnownTruth | None = None,
    closing: Closing | None = None,
    let_go: Callable[[], str | None] = lambda: None,
    show_progress: bool = True,
) -> tuple[Belief, Episode, str]:
    """Explore until it is enough, saving as it goes; returns belief, episode and why it ended.

    What an earlier run has `kept` in the folder stays, and `steps` come after it; where that is
    enough already, only what ends a run is missing. `let_go` is called once no more moves come,
    before the closing draws, and before all else where something fails; what it says is told.
    """
    kept = kept or Kept()

    def end(episode: Episode, reason: str) -> tuple[Belief, Episode, str]:
        left = let_go()
        if left is not None:
            run.bar.write(f"warning: {left}", file=sys.stderr)
        belief = run.finish(episode, truth)
        return belief, episode, stopping.closed_reason(reason, belief, task)

    total, episode = stopping.steps, kept.episode
    with (
        EstimationRun(
            folder, prior_name, total, kept.state, show_progress, closing, kept.belief
        ) as run,
        stopped_first(let_go),
    ):
        moves = 0 if kept.state is None else kept.state.index
        if episode is not None and kept.belief is not None and moves == len(episode) - 1:
            reason = stopping.reason(kept.belief, moves, task)
            if reason is not None:
                return end(episode, reason)
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
            reason = stopping.reason(step.estimation.belief, len(episode) - 1, task)
            if reason is not None:
                return end(episode, reason)
        if episode is None:
            raise ValueError("no move promises as much as was asked for; ask for less gain")
        return end(episode, "no move promises as much as was asked for")
