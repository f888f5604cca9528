"""Policies that follow a basic trajectory: scripts, and the paper's grid around one."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.information import GridSettings, grid_commands, grid_gain
from tpcd.policies.limits import Limits
from tpcd.policies.protocol import Choice, Situation
from tpcd.predict import ContactPredictor
from tpcd.truth.motions import History, Motion


class MotionPolicy:
    """A scripted motion, whatever the belief; `make` starts it from its beginning.

    With `limits` its commands are drawn back into their box.
    """

    def __init__(self, make: Callable[[], Motion], limits: Limits | None = None) -> None:
        self._make = make
        self._limits = limits
        self._motion: Motion | None = None
        self._asked = 0

    def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
        """The script's next command; after an interruption the script is run up to it."""
        asked = self._asked_next(situation.episode)
        command = self._drawn_back(asked, situation.episode)
        return Choice(command, asked=None if torch.equal(command, asked) else asked)

    def next_command(self, episode: Episode) -> Float[Tensor, " 3"]:
        """The command after the rows of an episode, within the limits."""
        return self._drawn_back(self._asked_next(episode), episode)

    def _asked_next(self, episode: Episode) -> Float[Tensor, " 3"]:
        """What the script asks for after the rows of an episode."""
        rows = len(episode)
        if self._motion is None or self._asked != rows - 1:
            self._motion, self._asked = self._make(), 0
        command = episode.commands[-1]
        for count in range(self._asked + 1, rows + 1):
            command = self._motion.next_command(
                History(
                    episode.commands[:count],
                    episode.poses[:count],
                    episode.wrenches[:count],
                    episode.stiffness,
                )
            )
        self._asked = rows
        return command

    def _drawn_back(self, command: Float[Tensor, " 3"], episode: Episode) -> Float[Tensor, " 3"]:
        if self._limits is None:
            return command
        return within(command, *self._limits.box(episode.poses[-1], episode.stiffness))


class GridPolicy:
    """The paper's `active`: the most informative of 27 commands around a basic trajectory."""

    def __init__(
        self, basic: MotionPolicy, limits: Limits, settings: GridSettings | None = None
    ) -> None:
        self._basic = basic
        self._limits = limits
        self._settings = settings or GridSettings()

    def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
        """The best of the grid, or staying here, that keeps within the force limit."""
        episode, belief = situation.episode, situation.belief
        commands = grid_commands(self._basic.next_command(episode), self._settings)
        commands = torch.cat((commands, episode.poses[-1:]))
        commands = within(commands, *self._limits.box(episode.poses[-1], episode.stiffness))
        count = max(1, round(self._settings.share * len(belief.weights)))
        prediction = ContactPredictor(belief, count).predict(
            episode.poses[-1].expand_as(commands),
            commands,
            previous=episode.commands[-1].expand_as(commands),
        )
        gain = grid_gain(prediction, self._settings)
        excess = self._limits.excess_probability(prediction)
        allowed = self._limits.probability
        best, forced = best_within(gain, excess, allowed), not bool((excess[:-1] <= allowed).any())
        return Choice(
            commands[best], float(gain[best]), len(commands) - 1, float(excess[best]), forced
        )


def within(commands: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Commands drawn back into a box."""
    return torch.minimum(torch.maximum(commands, low), high)


def best_within(value: Tensor, excess: Tensor, probability: float) -> int:
    """Index of the highest value among those of small enough excess; if none, the least excess."""
    allowed = excess <= probability
    if not bool(allowed.any()):
        return int(excess.argmin())
    return int(torch.where(allowed, value, -torch.inf).argmax())
