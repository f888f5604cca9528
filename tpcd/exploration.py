"""Exploration: choose a command, move, measure, learn, and again.

The robot may be real or simulated, the policy any, the estimator ours or the paper's. What
was measured and learnt is handed out after every step, so that nothing is lost when it ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import torch

from tpcd.belief.belief import (
    Belief,
    EstimationStep,
    EstimatorSettings,
    estimate,
    prior_belief,
)
from tpcd.belief.paper import PaperSettings, estimate_paper, paper_prior_belief
from tpcd.belief.refinement import held_belief, refine
from tpcd.belief.state import EstimatorState
from tpcd.data.episode import Episode
from tpcd.policies.protocol import Choice, Policy, Situation
from tpcd.random import stream
from tpcd.robot.protocol import Robot, stopped_first
from tpcd.shape.protocol import Shape

_POLICY_STREAM, _PRIOR_STREAM = 1, 2

Closing = Callable[[Episode, EstimatorState], EstimationStep]
"""Finds the belief that a state holds from many more draws."""


@dataclass(frozen=True)
class Estimator:
    """How beliefs are formed while an episode grows."""

    shape: Shape
    kind: Literal["default", "paper"] = "default"
    settings: EstimatorSettings = field(default_factory=EstimatorSettings)
    """Of the default estimator."""
    paper: PaperSettings = field(default_factory=PaperSettings)
    """Of the paper's filter."""

    def __post_init__(self) -> None:
        """Refuse effects where they would be left out."""
        if self.kind == "paper" and self.settings.effects:
            raise ValueError("the estimator paper has a model of its own, without effects")

    def before(self, episode: Episode, generator: torch.Generator) -> Belief:
        """The belief before any transition."""
        if self.kind == "paper":
            return paper_prior_belief(episode, self.shape, generator, self.paper)
        return prior_belief(episode, self.shape, generator, self.settings)

    def steps(
        self, episode: Episode, generator: torch.Generator, state: EstimatorState | None = None
    ) -> Iterator[EstimationStep]:
        """The beliefs after the transitions that `state` does not hold yet."""
        if self.kind == "paper":
            return estimate_paper(episode, self.shape, generator, self.paper, state)
        return estimate(episode, self.shape, generator, self.settings, state)

    @property
    def closing(self) -> Closing | None:
        """What finds the belief at the end of an episode from many more draws; None with the
        paper's filter, whose particles are what they are."""
        return None if self.kind == "paper" else self._refine

    def held(self, episode: Episode, state: EstimatorState) -> Belief | None:
        """The belief of the step that left the state; None with the paper's filter."""
        if self.kind == "paper":
            return None
        return held_belief(episode, self.shape, state, self.settings)

    def learn(self, episode: Episode, generator: torch.Generator) -> EstimationStep:
        """The belief after a whole episode."""
        *_, last = self.steps(episode, generator)
        return last if self.closing is None else self.closing(episode, last.state)

    def _refine(self, episode: Episode, state: EstimatorState) -> EstimationStep:
        return refine(episode, self.shape, state, self.settings)


@dataclass(frozen=True)
class ExplorationStep:
    """One move: why it was chosen, what it taught, and all rows so far."""

    choice: Choice
    choosing_seconds: float
    settled: bool
    estimation: EstimationStep
    episode: Episode


def explore(
    robot: Robot,
    policy: Policy,
    estimator: Estimator,
    seed: int,
    episode: Episode | None = None,
    belief: Belief | None = None,
    state: EstimatorState | None = None,
    on_row: Callable[[Episode], None] | None = None,
    least_gain: float = 0.0,
) -> Iterator[ExplorationStep]:
    """Explore until the best command promises less than `least_gain`, or the caller has enough.

    Where the limits allow nothing but to stay, and so to let go of all force, the arm does that
    whatever it promises.

    With `episode`, `belief` and `state` of an exploration that was stopped it goes on after
    their rows, with the very choices it would have made; rows that were measured but not yet
    learnt from come first. `on_row` is given all rows as soon as the last one is measured. Whatever
    fails, the robot is stopped first. Raises ValueError where no particle can explain what was
    measured.
    """
    generator = torch.Generator().manual_seed(seed)
    with stopped_first(robot.stop):
        if episode is None:
            episode = robot.start()
        else:
            robot.resume(episode)
            learnt = 0 if state is None else state.index
            if learnt < len(episode) - 1:
                for step in estimator.steps(episode, generator, state):
                    belief, state = step.belief, step.state
                    done = episode.first(step.index + 1)
                    yield ExplorationStep(Choice(done.commands[-1]), 0.0, True, step, done)
        if belief is None:
            belief = estimator.before(episode, stream(seed, _PRIOR_STREAM))
        while True:
            row = len(episode)
            started = time.perf_counter()
            choice = policy.choose(Situation(episode, belief), stream(seed, _POLICY_STREAM, row))
            seconds = time.perf_counter() - started
            if choice.gain is not None and choice.gain < least_gain and not choice.forced:
                return
            reading = robot.settle(choice.command)
            episode = episode.with_row(choice.command, reading.pose, reading.wrench)
            if on_row is not None:
                on_row(episode)
            (step,) = estimator.steps(episode, generator, state)
            belief, state = step.belief, step.state
            yield ExplorationStep(choice, seconds, reading.settled, step, episode)
