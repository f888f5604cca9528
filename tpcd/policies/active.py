"""Our own exploration: the command itself is optimised for what it is expected to teach.

Which commands are compared matters far more than how their gain is estimated. So there is
no basic trajectory and no grid: commands within reach are searched by the cross-entropy
method (Rubinstein 1999). Some are spread evenly; then normal distributions fitted to the
best ones are drawn from, and the best few of all are compared with more particles.

What is searched are goals up to a few steps away, since a wall out of reach teaches nothing
until one is there. A goal n steps away is worth its gain over the square root of n: divided by n
itself, the wall was put off again and again for what was near. The first step towards the goal is
what is commanded. Commands that exceed the force limit with more than the
set probability are not taken; where all others do, the arm goes to where it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.information import (
    belief_outcomes,
    expected_information_gain,
    expected_variance,
    present_variance,
)
from tpcd.policies.basic import best_within, within
from tpcd.policies.limits import Limits
from tpcd.policies.lookahead import second_step_gain
from tpcd.policies.protocol import Choice, Situation
from tpcd.predict import ContactPredictor
from tpcd.prediction import Prediction


@dataclass(frozen=True)
class ActiveSettings:
    """Budget of the search."""

    strides: float = 3.0
    """Goals are searched up to so many steps away."""
    stride_cost: float = 0.5
    """A goal n steps away is worth its gain over n to this power."""
    first: int = 96
    """Goals spread evenly over what is within reach, half of them within one step."""
    rounds: int = 3
    """Rounds of refinement."""
    later: int = 32
    """Commands of each round."""
    elite: int = 8
    """Best commands that a round is fitted to."""
    particles: int = 100
    """Particles that commands are compared with."""
    finalists: int = 8
    """Best commands of all that are compared once more."""
    final_particles: int = 300
    """Particles for that."""
    look_ahead: bool = False
    """Add to each finalist's gain that of the best command after it."""

    def __post_init__(self) -> None:
        """Refuse budgets without meaning."""
        least = {"first": 2, "rounds": 0, "later": 1, "elite": 2, "particles": 1, "finalists": 1}
        for name, limit in {**least, "final_particles": 1}.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < limit:
                raise ValueError(f"{name} is {value}, expected a whole number of at least {limit}")
        if not 0 < self.strides < math.inf or not 0 <= self.stride_cost < math.inf:
            both = f"strides is {self.strides} and stride_cost {self.stride_cost}"
            raise ValueError(f"{both}, expected finite numbers above 0, and of at least 0")


@dataclass(frozen=True)
class Task:
    """Motions the user wants predicted: n transitions from poses to commands [m, m, rad]."""

    poses: Float[Tensor, "n 3"]
    commands: Float[Tensor, "n 3"]
    previous: Float[Tensor, "n 3"] | None = None
    tolerance: tuple[float, float, float] = (1e-3, 1e-3, 5e-3)
    """Errors of the settled pose that count alike [m, m, rad]; forces follow from them."""
    stiffness: Float[Tensor, " 3"] | None = None
    """Stiffness that the commands are for [N/m, N/m, N·m/rad]; None: that of the belief."""

    def answers(
        self, predictor: ContactPredictor
    ) -> tuple[Float[Tensor, "m v"], Float[Tensor, "m v j"] | None]:
        """What particles predict, and how that answers their fields, in units of the tolerance."""
        prediction = self._predicted(predictor, keep_field=True)
        scale = torch.tensor(self.tolerance, dtype=torch.float64)
        field = prediction.component_field
        if field is not None:
            field = (field / scale[:, None]).flatten(1, 2)
        return (prediction.component_mean / scale).flatten(1), field

    def predicted_error(self, predictor: ContactPredictor) -> Float[Tensor, " 6"]:
        """Root mean square error that the belief expects of its predictions, each channel."""
        return self._predicted(predictor).std.square().mean(0).sqrt()

    def _predicted(self, predictor: ContactPredictor, keep_field: bool = False) -> Prediction:
        """What the belief predicts; `ValueError` where its arm is not the one of the commands."""
        if self.stiffness is not None:
            own, asked = predictor.belief.stiffness.tolist(), self.stiffness.tolist()
            if not torch.allclose(self.stiffness, predictor.belief.stiffness):
                raise ValueError(
                    f"the task is for an arm of stiffness {asked}, and this one has {own}; name an"
                    " episode recorded with the same controller"
                )
        return predictor.predict(self.poses, self.commands, self.previous, keep_field=keep_field)


class ActivePolicy:
    """Chooses the command of the largest expected gain of information within the limits.

    Raises ValueError for look-ahead with a task, whose gain it does not know.

    With a `task` it is what the task's predictions depend on that is learnt: the gain is the
    expected fall of their mean variance, in units of the tolerance squared.
    """

    def __init__(
        self, limits: Limits, settings: ActiveSettings | None = None, task: Task | None = None
    ) -> None:
        self._limits = limits
        self._settings = settings or ActiveSettings()
        self._task = task
        if task is not None and self._settings.look_ahead:
            raise ValueError("look-ahead adds up gains of information; leave it out with a task")

    def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
        """Search the commands within reach."""
        settings, allowed = self._settings, self._limits.probability
        predictor = ContactPredictor(situation.belief, settings.particles)
        goals = self._spread_goals(situation, generator)
        gain, excess = self._rate(predictor, situation, goals)
        low, high = self._reach(situation, settings.strides)
        for _ in range(settings.rounds):
            elite = goals[_ranked(gain, excess, allowed)[: settings.elite]]
            noise = torch.randn(settings.later, 3, generator=generator, dtype=torch.float64)
            fresh = within(elite.mean(0) + noise * elite.std(0), low, high)
            rated = self._rate(predictor, situation, fresh)
            goals = torch.cat((goals, fresh))
            gain, excess = (torch.cat(pair) for pair in zip((gain, excess), rated, strict=True))
        finalists = goals[_ranked(gain, excess, allowed)[: settings.finalists]]
        # To let go of all force and stay is always possible.
        finalists = torch.cat((finalists, situation.episode.poses[-1:]))
        predictor = ContactPredictor(situation.belief, settings.final_particles)
        gain, excess = self._rate(predictor, situation, finalists)
        if settings.look_ahead:
            gain = gain + self._second_gain(situation, finalists, generator)
        best = best_within(gain, excess, allowed)
        command = self._first_step(situation, finalists)[0][best]
        forced = not bool((excess[:-1] <= allowed).any())
        return Choice(command, float(gain[best]), len(goals), float(excess[best]), forced)

    def _second_gain(
        self, situation: Situation, goals: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Gain of the best command after the first step towards each goal."""
        episode = situation.episode
        predictor = ContactPredictor(situation.belief, self._settings.particles)
        commands, _ = self._first_step(situation, goals)
        outcomes, _ = belief_outcomes(
            predictor, episode.poses[-1], commands, episode.commands[-1], episode.sensor_std
        )
        return second_step_gain(
            predictor,
            outcomes,
            commands,
            episode.sensor_std,
            lambda pose: self._limits.box(pose, episode.stiffness),
            generator,
        )

    def _reach(self, situation: Situation, strides: float) -> tuple[Tensor, Tensor]:
        """Lowest and highest goal so many steps away."""
        episode = situation.episode
        return self._limits.box(episode.poses[-1], episode.stiffness, strides)

    def _spread_goals(self, situation: Situation, generator: torch.Generator) -> Tensor:
        seed = int(torch.randint(2**31, (), generator=generator))
        place = torch.quasirandom.SobolEngine(3, scramble=True, seed=seed)
        half = self._settings.first // 2
        near, far = (
            place.draw(self._settings.first).double().split((self._settings.first - half, half))
        )
        parts = []
        for share, strides in ((near, 1.0), (far, self._settings.strides)):
            low, high = self._reach(situation, strides)
            parts.append(low + (high - low) * share)
        return torch.cat(parts)

    def _first_step(self, situation: Situation, goals: Tensor) -> tuple[Tensor, Tensor]:
        """The command towards each goal, and how many steps the goal is away."""
        low, high = self._reach(situation, 1.0)
        here = within(situation.episode.poses[-1], low, high)
        offset = goals - here
        room = torch.where(offset > 0, high - here, here - low).clamp_min(1e-9)
        away = (offset.abs() / room).amax(-1).clamp_min(1.0)
        return here + offset / away[:, None], away

    def _rate(
        self, predictor: ContactPredictor, situation: Situation, goals: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gain for each step towards each goal, and the first step's probability of too much
        force."""
        episode = situation.episode
        commands, away = self._first_step(situation, goals)
        outcomes, prediction = belief_outcomes(
            predictor, episode.poses[-1], goals, episode.commands[-1], episode.sensor_std
        )
        excess = self._limits.excess_probability(prediction)
        far = torch.nonzero(away > 1.0)[:, 0]
        if len(far):
            start = episode.poses[-1].expand(len(far), 3)
            before = episode.commands[-1].expand(len(far), 3)
            nearer = predictor.predict(start, commands[far], before, episode.sensor_std[:3])
            excess[far] = self._limits.excess_probability(nearer)
        if self._task is None:
            return expected_information_gain(outcomes) / away**self._settings.stride_cost, excess
        values, field = self._task.answers(predictor)
        now = present_variance(outcomes.weights, values, field)
        fall = now - expected_variance(outcomes, values, field)
        return fall / away**self._settings.stride_cost, excess


def _ranked(gain: Tensor, excess: Tensor, probability: float) -> Tensor:
    """Indices of commands, the best first: allowed ones by gain, then others by their excess."""
    allowed = excess <= probability
    least = float(gain.min())
    return torch.where(allowed, gain, least - 1.0 - excess).argsort(descending=True)
