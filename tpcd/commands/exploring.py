"""An exploration into a run folder: the same files as an estimation, and the episode itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tpcd.belief.belief import Belief
from tpcd.commands.estimation import EstimationRun, KnownTruth
from tpcd.data.episode import Episode
from tpcd.exploration import ExplorationStep
from tpcd.policies.active import Task
from tpcd.predict import ContactPredictor

EPISODE_NAME = "explore"


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
    done: int = 0,
    show_progress: bool = True,
) -> tuple[Belief, Episode, str]:
    """Explore until it is enough, saving as it goes; returns belief, episode and why it ended.

    `done` steps of an earlier run in the folder, with the rows `episode`, are kept, and `steps`
    come after them; where they are all that was asked for, only what ends a run is missing.
    """
    with EstimationRun(folder, prior_name, stopping.steps, done, show_progress) as run:
        if episode is not None and done >= stopping.steps:
            return run.finish(episode, truth), episode, f"all {stopping.steps} moves are made"
        for step in steps:
            choice, episode = step.choice, step.episode
            if not step.settled:
                run.bar.write(
                    f"warning: the arm did not stand still after move {len(episode) - 1}",
                    file=sys.stderr,
                )
            x, z, angle = choice.command.tolist()
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
