"""Whether the force sensor's zero has stayed: what it reads wherever the arm is known to be free.

A sensor's zero drifts, and the arm cannot tell drift from contact where it may be touching: it
comes to rest at w = K (r - u) with either. So the wrench is looked at where the pose alone says
that the arm is free (`free_space`): after zeroing, after a move that ends there, at the end of a
retreat. Nothing is moved for it. In between the zero is taken to have gone evenly in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tpcd.data.limits import WRENCH_COLUMNS
from tpcd.quality.channels import listed_rows
from tpcd.quality.finding import Finding, Weight
from tpcd.robot.free_space import is_free
from tpcd.robot.preflight import CERTAIN, TILT, FreeAir
from tpcd.robot.protocol import Reading

UNITS = ("N", "N", "N·m")
TURNED = (1.0, 1.0, 0.1)
"""Of the force that turns with the tool under a wrong payload, and its torque: a lever of 0.1 m."""
OFF = 2.0
"""Standard deviations of a row's noise by which it has to be off to be named."""


@dataclass(frozen=True)
class _InAir:
    """The mean wrench in free air, and what noise and payload allow of it [N, N, N·m]."""

    after: str
    stamp: float
    wrench: Float[np.ndarray, " 3"]
    allowed: Float[np.ndarray, " 3"]


class ZeroWatch:
    """The zero of one episode, from when the sensor was zeroed in the air."""

    def __init__(
        self,
        air: FreeAir,
        there: FreeAir,
        row_std: Float[np.ndarray, " 6"],
        noise: Float[np.ndarray, " 3"],
        turning: float,
        first_new: int = 0,
    ) -> None:
        """Zeroed in `air`, free `there` at the start. `noise` is of single readings and `turning`
        the force that tilting by `TILT` leaves [N]; rows before `first_new` are of an earlier
        session."""
        self._std, self._noise, self._turning = row_std[3:], noise, turning
        self._free = [air.poses.mean(0), there.poses.mean(0)]
        self._angle, self._first_new = float(self._free[0][2]), first_new
        self._rows = {0: float(there.stamps.mean())}
        self._read = [self._of_air(air, "zeroing")]

    def moved(self, row: int, reading: Reading) -> None:
        """A row was measured."""
        assert reading.stamps is not None, "an arm has a clock"
        stamp, pose = float(np.mean(reading.stamps)), reading.pose.numpy()
        self._rows[row] = stamp
        if reading.settled and is_free(pose, self._free):
            wrench = reading.wrench.numpy()
            self._read.append(self._judged(f"row {row}", stamp, wrench, float(pose[2]), 0.0))

    def doubts(self, last: FreeAir | None = None) -> tuple[Finding, ...]:
        """A doubt for each channel that was off in free air beyond its noise, with the rows that
        are off; `last` was read in the air after the last row."""
        read = list(self._read)
        if last is not None:
            read.append(self._of_air(last, f"row {max(self._rows)}"))
        found = []
        for channel in range(3):
            worst = max(read, key=lambda one: abs(one.wrench[channel]) / one.allowed[channel])  # noqa: B023
            off = self._off(channel, read)
            if off and abs(worst.wrench[channel]) > worst.allowed[channel]:
                found.append(self._doubt(channel, worst, off))
        return tuple(found)

    def _off(self, channel: int, read: list[_InAir]) -> dict[int, float]:
        """The rows that are off, and by how much [N, N, N·m]."""
        stamps, values = [one.stamp for one in read], [one.wrench[channel] for one in read]
        off = {
            row: abs(float(np.interp(stamp, stamps, values)))
            for row, stamp in self._rows.items()
            if row >= self._first_new and stamp <= stamps[-1]
        }
        return {row: size for row, size in off.items() if size > OFF * self._std[channel]}

    def _of_air(self, air: FreeAir, after: str) -> _InAir:
        noise, angle = 1 / np.sqrt(len(air.stamps)), float(air.poses[:, 2].mean())
        return self._judged(after, float(air.stamps.mean()), air.wrenches.mean(0), angle, noise)

    def _judged(
        self,
        after: str,
        stamp: float,
        wrench: Float[np.ndarray, " 3"],
        angle: float,
        readings: float,
    ) -> _InAir:
        """What was read at an angle of the tool [rad], with so much of a single reading's noise
        beside that of a row."""
        turned = abs(angle - self._angle) / TILT * self._turning
        chance = np.hypot(self._std, readings * self._noise)
        return _InAir(after, stamp, wrench, CERTAIN * chance + turned * np.array(TURNED))

    def _doubt(self, channel: int, worst: _InAir, off: dict[int, float]) -> Finding:
        name, unit, least, most = (
            WRENCH_COLUMNS[channel], UNITS[channel], min(off.values()), max(off.values())
        )  # fmt: skip
        return Finding(
            "zero_drift",
            Weight.DOUBT,
            f"the sensor's zero has drifted: {name} reads {worst.wrench[channel]:.2g} {unit} in"
            f" free air after {worst.after}, expected at most {worst.allowed[channel]:.2g} {unit};"
            f" if it went evenly, {_named(sorted(off))} off by {least:.2g} to {most:.2g} {unit},"
            f" with a noise of {self._std[channel]:.2g} {unit}",
            (name,),
            remedy="record them anew with a sensor that is warm",
        )


def _named(rows: list[int]) -> str:
    shown = listed_rows(np.array(rows))
    return f"row {shown} is" if len(rows) == 1 else f"rows {shown} are"
