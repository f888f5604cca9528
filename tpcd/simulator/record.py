"""What goes into a quasi-static step and what comes out of it.

`StepSettings` are the choices of the simulator and `Transition` the answer for each element of the
batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor

from tpcd.parameters import LARGEST_FRICTION
from tpcd.qp.solve import BACKENDS

DEGREES = 3
"""Degrees of freedom of the object in the plane."""
LEAST_FINEST = 1e-6
"""Shorter parts cannot be told from rounding."""
MOST_PARTS = 100_000
"""Parts of equal length that a path may be cut into."""
START_DEPTH = 1e-3
"""A start pose further inside a terrain than this [m] is no error of a measurement."""
REST_TOLERANCE = 10.0
"""Times the tolerance that an answer may be from rest, in the words of `Transition.residual`. Where
it came to rest in rounds, that is at most once the tolerance."""


class StepStatus(IntEnum):
    """How the quasi-static step of one element ended, the better the lower; up to `RELAXED` there
    is an answer."""

    CONVERGED = 0, "converged"
    START_INSIDE = (
        1,
        f"converged, but the start pose is more than {1e3 * START_DEPTH:g} mm inside a terrain, out"
        " of which the object was pushed first; check the frame and the unit of the pose",
    )
    NOT_CONVERGED = (
        2,
        "the answer is not at rest, see its residual; raise rounds or substeps, or the stiffness"
        " about y where the object turned round",
    )
    RELAXED = 3, "jammed: no motion satisfies contact with friction; answered without friction"
    INVALID_INPUT = (
        4,
        "the pose, command or scene holds a NaN or an infinity, a friction that is not from 0 to"
        f" {LARGEST_FRICTION:g}, a compliance below 0, or a terrain whose direction is not of"
        " length 1",
    )

    sentence: str

    def __new__(cls, value: int, sentence: str) -> StepStatus:
        """An integer that carries the sentence a user reads."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.sentence = sentence
        return member


class ContactMode(IntEnum):
    """State of the contact with one terrain at the end of a step."""

    FREE = 0
    STICK = 1
    SLIP_POSITIVE = 2
    SLIP_NEGATIVE = 3


@dataclass(frozen=True)
class StepSettings:
    """Choices of the quasi-static simulator."""

    friction: Literal["coulomb", "anitescu"] = "coulomb"
    """`anitescu` is the convex relaxation (a sliding body is lifted by friction x slip);
    `coulomb` removes the lift by the fixed point of De Saxce and Feng (1998)."""
    substeps: int = 2
    """Parts into which the command's path is cut at least where contact changes on the way, since
    friction then depends on the path. With 1, nothing is ever cut. Where the parts end worse than
    the whole step (see `StepStatus`), the whole one is the answer."""
    finest: float = 1 / 32
    """Changes of contact are located where a load or a gap is expected to come to zero; where none
    is, parts are halved down to this share of the path (see `path`). With 1, and under convex
    friction, none is located."""
    largest_turn: float = 0.05
    """Most that the command turns in one part where anything is touched [rad]: what rolls or
    slips while it turns depends on the path too."""
    follow_path: bool = False
    """Cut every step into at least `substeps` parts, whether contact changes or not."""
    rounds: int = 20
    """Cap on re-linearisations of geometry and friction in one substep."""
    solver: Literal["native", "qpth"] = "native"
    """Backend of the contact problems (see `tpcd.qp`): `qpth` is slower by some hundred times, and
    what it gets wrong is told by status and residual."""
    tolerance: float = 1e-7
    """A substep has settled when a round moves no point, and no friction a gap, by more than this
    [m]."""

    def __post_init__(self) -> None:
        """Refuse settings that mean nothing."""
        if self.friction not in ("coulomb", "anitescu"):
            raise ValueError(f"friction is {self.friction!r}, expected 'coulomb' or 'anitescu'")
        if self.solver not in BACKENDS:
            told = ", ".join(BACKENDS)
            raise ValueError(f"solver is {self.solver!r}, expected one of {told}")
        for name in ("substeps", "rounds"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= MOST_PARTS:
                raise ValueError(f"{name} is {value}, expected a whole number, 1 to {MOST_PARTS}")
        if not LEAST_FINEST <= self.finest <= 1:
            raise ValueError(f"finest is {self.finest}, expected a share of {LEAST_FINEST} to 1")
        least = 2 * math.pi / MOST_PARTS
        if not self.largest_turn >= least:
            raise ValueError(
                f"largest_turn is {self.largest_turn}, expected radians from {least:.1g} on"
            )
        if not 0 < self.tolerance < math.inf:
            raise ValueError(f"tolerance is {self.tolerance}, expected a finite number > 0")


@dataclass(frozen=True)
class Transition:
    """Answer of one step for each element.

    `pose` (x, z, angle) [m, m, rad]; `wrench` (F_x, F_z, torque) [N, N, N·m] that the world
    exerts on the object about the end-effector origin; `mode` the `ContactMode` against each
    terrain; `residual` how far the answer is from rest [m]: the largest of what the last round
    moved, how deep the object is inside a terrain, how far from one under Coulomb friction whose
    load it bears, and how far the arm would still go for what its forces do not balance.
    """

    pose: Float[Tensor, "*batch 3"]
    wrench: Float[Tensor, "*batch 3"]
    mode: Int[Tensor, "*batch t"]
    status: Int[Tensor, "*batch"]
    residual: Float[Tensor, "*batch"]
    pose_from_start: Float[Tensor, "*batch 3 3"]
    """Derivative of the settled pose with respect to the start pose."""
    pose_from_gap: Float[Tensor, "*batch t 3"]
    """Derivative of the settled pose with respect to the gap to terrain t: what a wrong outline
    or a wrong terrain height does."""
    pose_from_lever: Float[Tensor, "*batch t 3"]
    """Derivative of the settled pose with respect to the lever of terrain t, the tangential
    offset of the contact point from the end effector [m]: what a shifted contact point does."""
    contacts: Float[Tensor, "*batch t 4"]
    """Force along the normal and along the tangent of terrain t [N], and the arm of the contact
    point from the end effector in world axes (x, z) [m]; zero without contact."""
