"""A recording as it was made: samples of pose, wrench and set point in three dimensions.

Everything is in SI units, in the axes of the recording's own world; which of those axes span
the plane is settled later (`plane`), and where steps begin and end too (`settled`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from tpcd.errors import FileError
from tpcd.quality.finding import Finding, usable
from tpcd.quality.stream import Stream

AXES = ("x", "y", "z")


class LogError(FileError):
    """A recording from elsewhere that cannot be used; names file and column or topic."""


RotationKind = Literal["quaternion", "rotation vector", "Euler angles", "planar angle"]


@dataclass(frozen=True, eq=False)
class RotationNumbers:
    """The numbers that rotations were read from, for who asks whether they were read rightly."""

    kind: RotationKind
    entries: Float[np.ndarray, "n w"]
    """Quaternions as x, y, z, w; angles and rotation vectors [rad]."""
    euler: str = ""
    """Axes of Euler angles, as scipy names them."""

    def rotations(self) -> Rotation:
        """What they mean; `ValueError` where they are no rotations."""
        if self.kind == "quaternion":
            return Rotation.from_quat(self.entries)
        if self.kind == "Euler angles":
            return Rotation.from_euler(self.euler, self.entries)
        if self.kind == "rotation vector":
            return Rotation.from_rotvec(self.entries)
        # The planar angle turns from x to z, about -y.
        return Rotation.from_rotvec(self.entries * np.array([0.0, -1.0, 0.0]))


@dataclass(frozen=True, eq=False)
class Log:
    """n samples of one recording."""

    path: Path
    times: Float[np.ndarray, " n"]
    """Since the first sample [s], increasing."""
    positions: Float[np.ndarray, "n 3"]
    """Of the end-effector origin in the world [m]."""
    rotations: Rotation
    """From the end effector to the world."""
    forces: Float[np.ndarray, "n 3"]
    """As the sensor gives them [N]; axes and sign are settled in `plane`."""
    torques: Float[np.ndarray, "n 3"]
    """As the sensor gives them [N·m]."""
    command_positions: Float[np.ndarray, "n 3"] | None = None
    """Set point of the impedance controller [m]; None where it was not recorded."""
    command_rotations: Rotation | None = None
    missing: frozenset[str] = frozenset()
    """Components that were not recorded and stand at zero: y, u_y, F_y, T_x, T_z, …"""
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    """Further columns that are to be kept."""
    notes: tuple[str, ...] = ()
    """What the reader had to do or leave out, for people."""
    streams: tuple[Stream, ...] = ()
    """The sensors as they were recorded, each on its own clock, before they were joined."""
    findings: tuple[Finding, ...] = ()
    """What checks of the recording found; their times are those of `times`."""
    numbers: RotationNumbers | None = None
    """What `rotations` were read from; None for quaternions."""
    command_numbers: RotationNumbers | None = None
    """The same of `command_rotations`."""
    columns: dict[str, str] = field(default_factory=dict)
    """Names of the map to columns of the table; empty for a bag."""

    @property
    def usable(self) -> Bool[np.ndarray, " n"]:
        """The samples that no finding leaves out."""
        return usable(self.times, self.findings)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.times)

    def during(self, start: float | None, end: float | None) -> Log:
        """The samples from `start` to `end` [s since the first]; raises `LogError` if too few."""
        low = -np.inf if start is None else start
        high = np.inf if end is None else end
        return self.only((self.times >= low) & (self.times <= high))

    def only(self, kept: Bool[np.ndarray, " n"]) -> Log:
        """Some of the samples; raises `LogError` where fewer than two are left."""
        if kept.sum() < 2:
            raise LogError(
                self.path,
                f"{int(kept.sum())} of {len(self)} samples can be used, from"
                f" {self.times[0]:.3g} to {self.times[-1]:.3g} s",
                "check the map of columns and the times to keep",
            )
        commanded, turned = self.command_positions, self.command_rotations
        chosen = np.flatnonzero(kept)
        return replace(
            self,
            times=self.times[kept],
            positions=self.positions[kept],
            rotations=_chosen(self.rotations, chosen),
            forces=self.forces[kept],
            torques=self.torques[kept],
            command_positions=None if commanded is None else commanded[kept],
            command_rotations=None if turned is None else _chosen(turned, chosen),
            extra={name: column[kept] for name, column in self.extra.items()},
            numbers=_chosen_numbers(self.numbers, chosen),
            command_numbers=_chosen_numbers(self.command_numbers, chosen),
        )


def _chosen_numbers(
    numbers: RotationNumbers | None, samples: Int[np.ndarray, " k"]
) -> RotationNumbers | None:
    return None if numbers is None else replace(numbers, entries=numbers.entries[samples])


def _chosen(rotations: Rotation, samples: Int[np.ndarray, " k"]) -> Rotation:
    return Rotation.from_quat(rotations.as_quat()[samples])
