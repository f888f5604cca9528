"""An episode: commands, settled poses and wrenches of one recording.

Row k holds command k and what was measured once the arm had settled after it; row 0 is
the free start pose, its command equal to the pose. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contract import (
    as_numbers,
    check_finite,
    check_noise,
    check_pose,
    check_prior,
    check_stiffness,
)
from tpcd.data.limits import COMMAND_COLUMNS, POSE_COLUMNS, WRENCH_COLUMNS
from tpcd.parameters import SCENE_NAMES, SCENE_UNITS
from tpcd.quality.finding import Finding

COLUMNS = ("step", *COMMAND_COLUMNS, *POSE_COLUMNS, *WRENCH_COLUMNS)


@dataclass(frozen=True, eq=False)
class Episode:
    """One recording of n rows; all tensors are float64 on the CPU, in SI units.

    Poses and commands are (x, z, phi) [m, m, rad] of the end effector in the world;
    wrenches (F_x, F_z, tau) [N, N, N·m] are what the world exerts on the object about the
    end-effector origin, in world axes. Arrays and lists are taken for tensors. `TypeError` and
    `ValueError` for other shapes and, unless `unusual`, for what looks like millimetres, degrees or
    N/mm (see `tpcd.contract`).
    """

    commands: Float[Tensor, "n 3"]
    poses: Float[Tensor, "n 3"]
    wrenches: Float[Tensor, "n 3"]
    stiffness: Float[Tensor, " 3"]
    """Diagonal of K [N/m, N/m, N·m/rad]."""
    sensor_std: Float[Tensor, " 6"]
    """One standard deviation of the noise of x, z, phi, F_x, F_z, tau in their units."""
    object: str | None = None
    notes: str | None = None
    time_step_s: float | None = None
    priors: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Uniform priors (low, high) for entries of theta; what is missing takes the defaults."""
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    """Further columns of the table, each of length n."""
    doubts: tuple[Finding, ...] = ()
    """What it was accepted in spite of; part of its YAML."""
    path: Path | None = None
    """The table the episode was read from."""
    unusual: bool = False
    """That lengths beyond 5 m, angles beyond a turn and springs no arm has are meant so."""

    def __post_init__(self) -> None:
        cpu = torch.device("cpu")
        for name, last in {"stiffness": 3, "sensor_std": 6}.items():
            value = as_numbers(name, getattr(self, name), last, axes=1, device=cpu)
            object.__setattr__(self, name, value.double())
        for name in ("commands", "poses", "wrenches"):
            value = as_numbers(name, getattr(self, name), 3, device=cpu).double()
            object.__setattr__(self, name, value)
            shape = (len(self.commands), 3)
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {shape}")
        check_stiffness(self.stiffness, self.unusual)
        check_noise("sensor_std", self.sensor_std, self.unusual)
        for name in ("commands", "poses"):
            check_pose(name, getattr(self, name), self.unusual)
        for name, column in self.extra.items():
            if name in COLUMNS or np.shape(column) != (len(self),):
                told = f"extra column {name!r} must be new and of length {len(self)}"
                raise ValueError(told)

    def check_learnable(self) -> None:
        """Refuse rows, noise and priors that nothing can be learnt from; ValueError names them."""
        if len(self) == 0:
            raise ValueError("the episode has no rows, expected one of the start pose at least")
        for name in ("commands", "poses", "wrenches"):
            check_finite(name, getattr(self, name))
        for name, unit in zip(SCENE_NAMES, SCENE_UNITS, strict=True):
            if name in self.priors:
                check_prior(name, self.priors[name], unit, self.unusual)

    def __len__(self) -> int:
        """Number of rows, the start row included."""
        return self.commands.shape[0]

    def first(self, rows: int) -> Episode:
        """The first rows only."""
        return replace(
            self,
            commands=self.commands[:rows],
            poses=self.poses[:rows],
            wrenches=self.wrenches[:rows],
            extra={name: column[:rows] for name, column in self.extra.items()},
        )

    def with_row(
        self,
        command: Float[Tensor, " 3"],
        pose: Float[Tensor, " 3"],
        wrench: Float[Tensor, " 3"],
    ) -> Episode:
        """The episode with one more row; raises ValueError where it has further columns."""
        if self.extra:
            raise ValueError(f"no values for the further columns {', '.join(self.extra)}")
        return replace(
            self,
            commands=torch.cat((self.commands, command.double()[None])),
            poses=torch.cat((self.poses, pose.double()[None])),
            wrenches=torch.cat((self.wrenches, wrench.double()[None])),
        )
