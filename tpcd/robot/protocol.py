"""What exploration needs of an arm, whether real or simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.quality.finding import Finding


@dataclass(frozen=True)
class Reading:
    """What was measured once the arm had settled."""

    pose: Float[Tensor, " 3"]
    """(x, z, phi) of the end effector in the world [m, m, rad]."""
    wrench: Float[Tensor, " 3"]
    """(F_x, F_z, tau) that the world exerts on the object [N, N, N·m]."""
    settled: bool = True
    """Whether the arm stood still in time."""
    sensor_std: Float[Tensor, " 6"] | None = None
    """Standard deviation of the noise of pose and wrench, where it is known."""
    stamps: tuple[float, float] | None = None
    """First and last moment of what was averaged, in the arm's own time [s]; None: no clock."""


@runtime_checkable
class Robot(Protocol):
    """An arm under Cartesian impedance control that holds an object."""

    def start(self) -> Episode:
        """Take the free start pose; an episode of that one row, with stiffness and noise."""
        ...

    def settle(self, command: Float[Tensor, " 3"]) -> Reading:
        """Go to a command [m, m, rad] and measure once the arm stands still."""
        ...

    def resume(self, episode: Episode) -> None:
        """Go on after the rows of an exploration that was stopped."""
        ...

    def stop(self) -> str | None:
        """Stop all motion at once; how the robot was left where it may still touch something."""
        ...

    def doubts(self) -> tuple[Finding, ...]:
        """What is doubtful of the rows measured since it started or went on; a stop may tell
        more."""
        ...

    def close(self) -> None:
        """Let go of the arm."""
        ...


@contextmanager
def stopped_first(stop: Callable[[], object]) -> Iterator[None]:
    """A block whose failure stops the arm before anybody writes, draws or tells.

    The arm may press on something between two moves, so also what fails then ends in its retreat.
    Closing a generator is no failure.
    """
    try:
        yield
    except GeneratorExit:
        raise
    except BaseException:
        stop()
        raise
