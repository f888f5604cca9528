"""What a policy is told and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.data.episode import Episode


@dataclass(frozen=True)
class Situation:
    """Where the exploration stands: the rows measured so far, and the belief after them."""

    episode: Episode
    belief: Belief


@dataclass(frozen=True)
class Choice:
    """The next command, and what the policy expects of it."""

    command: Float[Tensor, " 3"]
    """Command [m, m, rad] in the world."""
    gain: float | None = None
    """What the command was chosen for, in the unit of the policy's objective (None: a script)."""
    considered: int = 1
    """Commands that were compared."""
    excess_probability: float | None = None
    """Probability, in the belief, that the command exceeds the force limit."""
    forced: bool = False
    """Whether the limits allow nothing but to stay, or not even that: then the gain says nothing
    of what is left to learn."""
    asked: Float[Tensor, " 3"] | None = None
    """What a script asked for, where the limits drew it back [m, m, rad]."""


@runtime_checkable
class Policy(Protocol):
    """Something that chooses the next command."""

    def choose(self, situation: Situation, generator: torch.Generator) -> Choice:
        """The next command. Policies keep no memory besides the rows they are shown, so that an
        exploration that was stopped goes on with the same choices."""
        ...
