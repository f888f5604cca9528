"""What must be so before an arm may explore: payload, wrench and noise in free air.

Zeroing hides whatever the sensor carries at that moment, so the wrench is looked at before, after,
at the start pose and in the air above it (`touch`), and with the tool tilted: what was zeroed turns
with the sensor and weight does not, so a payload that is off by m shows as a force of m g times the
angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from tpcd.errors import RobotError
from tpcd.quality.habit import find_habit
from tpcd.robot.free_space import LARGEST_BEFORE_ZEROING
from tpcd.robot.settling import SettlingSettings

TOUCHING = (0.3, 0.3, 0.03)
"""Change of a wrench that is contact, where noise is smaller [N, N, N·m]: well below the 0.5 N that
are never to be missed; of the torque what that is at a lever of 0.1 m."""
CERTAIN = 5.0
"""Standard deviations that noise does not reach, but in one start of half a million."""
LARGEST_DRIFT = 0.15
"""Of a force in free air [N/s]."""
TILT = 0.1
"""Angle to which the tool is tilted both ways, within the workspace [rad]."""
LARGEST_MASS = 0.3
"""Payload that may be missing or too much [kg]."""
GRAVITY = 9.81
ARM = (3e-5, 3e-5, 1e-4)
"""How well an arm knows the pose of what it holds, whatever its readings scatter by [m, m, rad]:
the pose repeatability of a UR5e by ISO 9283 (Universal Robots, UR5e data sheet: 0.03 mm), for the
angle over the 0.3 m from the wrist to what is held. Flat faces on tiles that yield tilt as much."""


@dataclass(frozen=True)
class FreeAir:
    """Readings (n, 3) of an arm that stands still in free air."""

    stamps: Float[np.ndarray, " n"]
    poses: Float[np.ndarray, "n 3"]
    wrenches: Float[np.ndarray, "n 3"]

    @property
    def force(self) -> float:
        """Size of the mean force [N]."""
        return float(np.linalg.norm(self.wrenches.mean(0)[:2]))


def check_payload(stated: float | None, told: float) -> None:
    """Raises RobotError where the controller was told another mass than stated [kg]."""
    if stated is not None and abs(stated - told) > 0.05:
        raise RobotError(
            f"the controller was told a payload of {told:.2f} kg, expected {stated:.2f} kg as"
            " stated; set it in the installation, with its centre of gravity"
        )


def check_before_zeroing(air: FreeAir) -> None:
    """Raises RobotError for a wrench that is no offset of the sensor."""
    if air.force > LARGEST_BEFORE_ZEROING:
        raise RobotError(
            f"a force of {air.force:.1f} N before zeroing, expected at most"
            f" {LARGEST_BEFORE_ZEROING:g} N in free air; the arm touches something, or its payload"
            " is wrong"
        )


def check_drift(air: FreeAir) -> None:
    """Raises RobotError where a force drifts."""
    slope = np.polynomial.polynomial.polyfit(air.stamps - air.stamps[0], air.wrenches, 1)[1]
    drift = float(np.abs(slope[:2]).max())
    noise = CERTAIN * _slope_noise(air)
    if drift > LARGEST_DRIFT + noise:
        raise RobotError(
            f"the force drifts by {drift:.2f} N/s in free air, expected at most"
            f" {LARGEST_DRIFT:g} N/s; let the sensor warm up, and look at its cable and mounting"
        )


def check_zeroed(air: FreeAir) -> None:
    """Raises RobotError where a sensor does not read zero right after it was zeroed in the air, to
    within the noise of the one reading that it may have been zeroed on."""
    first = np.polynomial.polynomial.polyfit(air.stamps - air.stamps[0], air.wrenches, 1)[0]
    allowed = np.maximum(TOUCHING, CERTAIN * reading_noise(air))
    if bool((np.abs(first) > allowed).any()):
        raise RobotError(
            f"{_shown(first)} in free air right after zeroing, expected at most {_shown(allowed)};"
            " the sensor was not zeroed, or does not hold its zero: look at its cable and mounting"
        )


@dataclass(frozen=True)
class Touch:
    """What an arm feels at a place beyond what it reads in the air, and what chance explains."""

    wrench: Float[np.ndarray, " 3"]
    """[N, N, N·m]"""
    allowed: Float[np.ndarray, " 3"]
    """Size of a wrench that is no contact [N, N, N·m]."""

    @property
    def felt(self) -> bool:
        """Whether there is contact."""
        return bool((np.abs(self.wrench) > self.allowed).any())

    def __str__(self) -> str:
        return f"{_shown(self.wrench)} (without contact at most {_shown(self.allowed)})"


def touch(place: FreeAir, air: FreeAir) -> Touch:
    """The contact at a place: its mean wrench less that of the air at the same time, which is the
    line through the air's readings. The same tool angle and zero belong to both.

    The line's value at a time t has the variance s² (1/n + (t - mean)² / sum (t_i - mean)²), with s
    the standard deviation of a reading (linear regression).
    """
    middle = float(air.stamps.mean())
    line = np.polynomial.polynomial.polyfit(air.stamps - middle, air.wrenches, 1)
    ahead = float(place.stamps.mean()) - middle
    spread = float(np.square(air.stamps - middle).sum())
    share = 1 / len(place.stamps) + 1 / len(air.stamps) + ahead**2 / spread
    allowed = np.maximum(TOUCHING, CERTAIN * reading_noise(air) * np.sqrt(share))
    return Touch(place.wrenches.mean(0) - line[0] - ahead * line[1], allowed)


def check_tilted(left: FreeAir, right: FreeAir) -> float:
    """The force that turns with the tool, each way and beyond noise [N]; raises RobotError for a
    wrong payload."""
    both = (left, right)
    difference = float(np.linalg.norm((right.wrenches.mean(0) - left.wrenches.mean(0))[:2]))
    angle = abs(float(right.poses[:, 2].mean() - left.poses[:, 2].mean()))
    allowed = LARGEST_MASS * GRAVITY * angle
    if difference > allowed:
        raise RobotError(
            f"the force changes by {difference:.2f} N when the tool turns by {angle:.2f} rad in"
            f" free air, expected at most {allowed:.2f} N; the payload is wrong by about"
            f" {difference / (GRAVITY * angle):.2f} kg"
        )
    noise = sum(reading_noise(air)[:2] @ reading_noise(air)[:2] / len(air.stamps) for air in both)
    return float(np.sqrt(max(0.0, difference**2 - noise))) / 2


def reading_noise(air: FreeAir) -> Float[np.ndarray, " 3"]:
    """Standard deviation of one reading of the wrench [N, N, N·m]."""
    return np.diff(air.wrenches, axis=0).std(0) / np.sqrt(2)


def longest_repeat(air: FreeAir) -> float:
    """For how many readings a working sensor repeats a number in any of its channels; 0 where free
    air does not tell."""
    habits = [find_habit(channel) for channel in air.wrenches.T]
    return max(habit.longest if habit.lively else 0.0 for habit in habits)


def mean_noise(
    air: FreeAir, window: float
) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, " 6"]]:
    """Standard deviations of the mean pose and wrench over so many seconds, from fast and from
    slow noise.

    Fast is what independent readings have. Slow, such as drift, is what the means of the windows
    in `air` scatter by, zero where chance explains it (probability 0.01).
    """
    values = np.concatenate((air.poses, air.wrenches), axis=1)
    duration = float(air.stamps[-1] - air.stamps[0])
    count = max(1, round(len(values) * window / duration))
    fast = np.diff(values, axis=0).std(0) / np.sqrt(2 * count)
    batches = len(values) // count
    if batches < 3:
        return fast, np.zeros(6)
    means = values[: batches * count].reshape(batches, count, 6).mean(1)
    scatter = means.std(0, ddof=1)
    chance = chi2.ppf(0.99, batches - 1) / (batches - 1)
    return fast, np.where(scatter**2 > chance * fast**2, scatter, 0.0)


def _shown(wrench: Float[np.ndarray, " 3"]) -> str:
    return f"({wrench[0]:.2f} N, {wrench[1]:.2f} N, {wrench[2]:.3f} N·m)"


def _slope_noise(air: FreeAir) -> float:
    """Standard deviation of a fitted slope of a force, if readings are independent [N/s]."""
    spread = air.stamps.std() * np.sqrt(len(air.stamps))
    return float((reading_noise(air)[:2] / spread).max())


def row_noise(
    air: FreeAir, turning: float, settling: SettlingSettings, stiffness: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 6"]:
    """Standard deviations of a row, from readings in free air and the force that `turning` the
    tool leaves [N].

    At rest the mean wrench is K (r - u), noise and all, to within a quarter of what may be left
    where a row counts as still (measured on the emulator). In free air the spring has turned all of
    that into motion; in contact it has not, so that poses are better there than stated. No pose is
    better than an arm's (`ARM`).
    """
    fast, slow = mean_noise(air, settling.window)
    still = 0.25 * np.array(settling.residual)
    wrench_std = np.sqrt(still**2 + fast[3:] ** 2 + slow[3:] ** 2)
    read = fast[:3] ** 2 + slow[:3] ** 2 + np.square(ARM)
    pose_std = np.sqrt(read + (wrench_std / stiffness) ** 2)
    wrench_std[:2] = np.hypot(wrench_std[:2], 0.5 * turning)
    return np.concatenate((pose_std, wrench_std))
