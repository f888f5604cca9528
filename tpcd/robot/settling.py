"""When an arm has settled, and when its force control has gone unstable.

Both look at a window of recent readings. A sample is the window after the one in which pose and
wrench no longer moved and nothing was left that would move them, however long that takes. A loop
that is unstable with a delayed surface shows an oscillation of the wrench that does not die out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class SettlingSettings:
    """What counts as still; forces in N, torque in N·m, lengths in m, angles in rad."""

    window: float = 0.6
    """Length of the window [s]."""
    pose_change: tuple[float, float, float] = (1e-4, 1e-4, 2e-4)
    """Largest difference between the mean poses of the window's halves."""
    wrench_change: tuple[float, float, float] = (0.08, 0.08, 0.004)
    """The same of the wrench, on top of what its noise makes."""
    slack: float = 10.0
    """Times `pose_change` that are allowed in the window that is taken: in the air noise of the
    force moves the arm, but not by as much as a slip."""
    residual: tuple[float, float, float] = (0.03, 0.03, 0.005)
    """Largest mean of K (u - r) + w over the window. Divided by K it is how far the arm may still
    be from rest where it slides or hangs free, so no noise is added to it: with more noise it
    only takes longer."""
    noise_factor: float = 4.0
    """Standard deviations of a difference of means that noise may account for."""
    oscillation: float = 1.0
    """Oscillation of a force, as standard deviation, that is not noise [N]; of a torque a tenth."""
    lasting: float = 1.0
    """Time for which it must not die out [s]."""
    dying: float = 0.7
    """An oscillation that has come down to this share of its largest is dying out."""
    crossings: int = 6
    """Changes of sign in a window that make an oscillation."""


@dataclass(frozen=True)
class Still:
    """Mean over a window in which nothing moved."""

    pose: Float[np.ndarray, " 3"]
    wrench: Float[np.ndarray, " 3"]
    start: float
    """Stamp of its first reading [s]."""
    end: float
    """Stamp of its last reading [s]."""
    count: int
    """Readings in it."""


class Window:
    """The readings of the last moments; `noise` is the standard deviation of one wrench reading
    [N, N, N·m]."""

    def __init__(self, settings: SettlingSettings, noise: Float[np.ndarray, " 3"]) -> None:
        self.settings, self._noise = settings, noise
        self._rows: deque[np.ndarray] = deque()
        self._rested: float | None = None
        """Stamp of the end of that first window."""
        self._ringing: tuple[float, np.ndarray] | None = None
        """Since when the wrench oscillates, and how much at most; 0 for an axis that does not."""

    def add(
        self,
        stamp: float,
        pose: Float[np.ndarray, " 3"],
        wrench: Float[np.ndarray, " 3"],
        residual: Float[np.ndarray, " 3"],
    ) -> None:
        """Append a reading and drop what is older than the window; stamps [s] must grow."""
        self._rows.append(np.concatenate(([stamp], pose, wrench, residual)))
        while stamp - float(self._rows[0][0]) > self.settings.window:
            self._rows.popleft()

    @property
    def full(self) -> bool:
        """Whether the readings cover the window."""
        rows = self._rows
        return len(rows) > 8 and float(rows[-1][0] - rows[0][0]) > 0.9 * self.settings.window

    def still(self) -> Still | None:
        """The means of the window after the first one in which pose and force were steady and
        nothing was left to move them; what still comes nearer then is off to the same side."""
        if not self.full or self._ringing is not None:
            return None
        rows, settings = np.array(self._rows), self.settings
        now = float(rows[-1, 0])
        if self._rested is not None:
            if now - self._rested < 0.98 * settings.window:
                return None
            if self._steady(rows, settings.slack):
                return self.mean()
            self._rested = None
        elif self._steady(rows) and (np.abs(rows[:, 7:10].mean(0)) <= settings.residual).all():
            self._rested = now
        return None

    def _steady(self, rows: Float[np.ndarray, "k c"], slack: float = 1.0) -> bool:
        settings = self.settings
        half = len(rows) // 2
        change = np.abs(rows[half:].mean(0) - rows[:half].mean(0))
        noise = settings.noise_factor * self._noise * np.sqrt(2 / half)
        moved = (change[1:4] > slack * np.array(settings.pose_change)).any()
        return not (moved or (change[4:7] > settings.wrench_change + noise).any())

    def mean(self) -> Still:
        """The means, whether still or not; raises ValueError where nothing was read."""
        if not self._rows:
            raise ValueError("the window is empty, expected at least one reading")
        rows = np.array(self._rows)
        mean = rows.mean(0)
        return Still(mean[1:4], mean[4:7], float(rows[0, 0]), float(rows[-1, 0]), len(rows))

    def unstable(self) -> bool:
        """Whether the wrench has oscillated for `lasting` without dying out: what rings after
        a touch shrinks meanwhile. To be asked all along, as often as is wanted."""
        if not self.full:
            return False
        now = float(self._rows[-1][0])
        size, large, swings = self._swing()
        if self._ringing is not None:
            since, largest = self._ringing
            largest = np.where(largest > 0, np.maximum(largest, size), 0.0)
            self._ringing = since, largest
            if not (large & (size > self.settings.dying * largest) & (largest > 0)).any():
                self._ringing = None
            elif now - since > self.settings.lasting:
                return True
        if self._ringing is None and swings.any():
            self._ringing = now, np.where(swings, size, 0.0)
            self._rested = None  # What rested before it says nothing of what comes after.
        return False

    @property
    def swing(self) -> float:
        """How much the wrench oscillates, in terms of `oscillation`; 0 where it does not."""
        if self._ringing is None:
            return 0.0
        most = self._ringing[1] * np.array([1.0, 1.0, 10.0])
        return float(most.max()) / self.settings.oscillation

    def _swing(
        self,
    ) -> tuple[Float[np.ndarray, " 3"], Bool[np.ndarray, " 3"], Bool[np.ndarray, " 3"]]:
        """Of each axis of the wrench the standard deviation about a line in the window's second
        half, whether it is more than noise, and whether it is an oscillation that lasts."""
        rows, settings = np.array(self._rows), self.settings
        stamps, wrench = rows[:, 0] - rows[0, 0], rows[:, 4:7]
        line = np.polynomial.polynomial.polyfit(stamps, wrench, 1)
        swing = wrench - np.polynomial.polynomial.polyval(stamps, line).T
        half = len(rows) // 2
        before, after = swing[:half].std(0), swing[half:].std(0)
        least = np.array([1.0, 1.0, 0.1]) * settings.oscillation
        large = after > np.maximum(least, settings.noise_factor * self._noise)
        # Noise on a slow swing crosses zero often too; it must have got clearly past it.
        outside = np.where(np.abs(swing) > 0.5 * swing.std(0), np.sign(swing), 0.0)
        crossings = np.array([_sign_changes(column) for column in outside.T])
        return after, large, large & (after > 0.8 * before) & (crossings >= settings.crossings)


def _sign_changes(signs: np.ndarray) -> int:
    signs = signs[signs != 0]
    return int((signs[1:] != signs[:-1]).sum())
