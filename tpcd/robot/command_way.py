"""How a command goes over to the next one: straight, and only as fast as the arm follows.

Friction remembers the way, so where an arm comes to rest depends on the way its command took. In a
step of the model the command goes straight from the one before to the next, with contact in
equilibrium all along. An arm whose command jumps turns, presses and slides each at a pace of its
own instead, and sticks elsewhere: by up to 10 mm where it turns in contact (emulated, 2 and 3 mm
at 10 N). So the command waits where it is far ahead of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tpcd.robot.admittance import AdmittanceSettings, AdmittanceState, residual

LEAD = (0.01, 0.01, 0.01)
"""How far a command may be ahead of where the arm would rest [m, m, rad]; there it waits. With
twice the angle, turns are a third quicker and end twice as far off (emulated)."""
PACE = (0.05, 0.05, 0.4)
"""Speed of a command whose arm is at rest all along [m/s, m/s, rad/s]."""


@dataclass(frozen=True)
class CommandWay:
    """A command on its way."""

    start: Float[np.ndarray, " 3"]
    way: Float[np.ndarray, " 3"]
    """From the start to the goal [m, m, rad]."""
    share: float = 0.0
    """How much of it is done."""

    @property
    def command(self) -> Float[np.ndarray, " 3"]:
        """Where it is now [m, m, rad]."""
        return self.start + self.share * self.way


def command_way(start: Float[np.ndarray, " 3"], goal: Float[np.ndarray, " 3"]) -> CommandWay:
    """The way from a command to the next one; the angle goes the shorter way round."""
    way = goal - start
    way[2] = np.remainder(way[2] + np.pi, 2 * np.pi) - np.pi
    return CommandWay(start, way)


def moved_on(
    way: CommandWay, settings: AdmittanceSettings, state: AdmittanceState, step: float
) -> CommandWay:
    """The command after `step` more seconds: the slower, the farther the arm is from rest."""
    needed = float((np.abs(way.way) / np.array(PACE)).max())
    pull = residual(settings, replace(state, wrench=state.slow), way.command)
    lead = np.abs(pull) / np.array(settings.stiffness)
    pace = max(0.0, 1.0 - float((lead / np.array(LEAD)).max()))
    return replace(way, share=min(1.0, way.share + pace * step / needed) if needed else 1.0)
