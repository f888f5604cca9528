"""What a source of true contact behaviour offers, and how it is called over an episode.

A truth holds one object in one scene. It keeps the state of the arm between steps, since
friction makes the outcome depend on the path. Units SI, frames as everywhere: poses and
commands of the end effector in the world, wrench of the world on the object about the
end-effector origin in world axes.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Truth(Protocol):
    """One object in one scene, at one pose, answering commands."""

    def reset(self, pose: Float[Tensor, " 3"]) -> None:
        """Put the arm at rest at a pose with the command equal to it [m, m, rad]."""
        ...

    def step(
        self, command: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"], bool]:
        """Move to a command; returns settled pose, wrench [N, N, N·m] and whether it settled."""
        ...
