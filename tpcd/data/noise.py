"""Noise of the sensors as the data themselves show it, without any model of contact.

Three things need no theta: a command that is given twice in a row leaves the arm where it is, so
both rows differ by noise alone; in free space the arm comes to where it is sent; and in equilibrium
w = K (x - u), whatever is touched. What departs from the last smoothly, as gains, biases, drifts,
lags and turned sensors do, is fitted away first.

No effect makes readings scatter less than their noise, so noise that is stated far too large is
certain; noise that looks too small may be an effect that shows in pauses, such as a lag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float

from tpcd.contract import SENSOR_NAMES
from tpcd.errors import EpisodeError
from tpcd.planar import short_way
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.habit import grid_step, resolution

if TYPE_CHECKING:
    from tpcd.data.episode import Episode

FEWEST_PAUSES = 3
"""Repeats below which their scatter says nothing."""
CLIP, ROUNDS = 5.0, 10
"""Rows this many standard deviations from where they were sent are not free; who is free and how
much they scatter is settled in so many rounds at most."""
CURVES = 7
"""Terms that are fitted away from w - K (x - u)."""
POSES_SHARE = 0.2
"""Noise of a force is read from w - K (x - u) where that of the pose is at most this part of it."""
SURE, LIKELY = 1e-6, 1e-4
"""Probabilities below which stated noise is refused, or warned of."""
TOO_LARGE, TOO_SMALL, FAR_TOO_SMALL = 1 / 3, 2.0, 6.0
"""Scatter over stated noise at which it is refused as too large, doubted, and refused as too small:
what the arm does besides may scatter as well."""
FEWEST_LEVELS, ROUNDED = 8, 0.5
"""Different readings from which steps can be told, and the part of the stated noise from which what
rounding adds is told."""
NEAR = 0.2
"""Readings count as near where they would be within so many standard deviations."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of x, z, phi, F_x, F_z, tau, and what it rests on.

    One standard error is added, for noise that is taken too small looks like physics.
    """

    std: tuple[float, ...]
    """One standard deviation, and its standard error."""
    freedom: tuple[int, ...]
    """Degrees of freedom; the relative standard error is about 1 / sqrt(2 freedom)."""

    def sentence(self) -> str:
        """The estimate in words, ready for a YAML."""
        values = ", ".join(f"{value:.2g}" for value in self.std)
        error = 1 / math.sqrt(2 * min(self.freedom))
        return (
            f"sensor_std estimated as [{values}] from repeated commands, free rows and"
            f" w - K (x - u); good to about {error:.0%}, which is added"
        )


def estimate_noise(episodes: Sequence[Episode]) -> NoiseEstimate | None:
    """Noise of the sensors from episodes of one set-up; None where too few commands repeat.

    What the episodes say of their noise is not used.
    """
    squares, freedom = _pauses(episodes)
    if freedom < FEWEST_PAUSES:
        return None
    readings = np.concatenate([_readings(episode) for episode in episodes])
    least = np.array([resolution(column) for column in readings.T]) / math.sqrt(12.0)
    std = np.maximum(np.sqrt(squares / freedom), least)
    counts = np.full(6, freedom)
    away = np.concatenate([_away(episode)[1:] for episode in episodes])
    wrenches = np.concatenate([episode.wrenches.numpy()[1:] for episode in episodes])
    free = np.zeros(len(away), dtype=bool)
    for _ in range(ROUNDS):
        before, free = free, (np.abs(away) <= CLIP * std[:3]).all(1)
        if free.sum() < 2 or (free == before).all():
            break
        own = wrenches[free] - wrenches[free].mean(0)
        together = squares + np.append((away[free] ** 2).sum(0), (own**2).sum(0))
        counts = freedom + np.array([free.sum()] * 3 + [free.sum() - 1] * 3)
        std = np.maximum(np.sqrt(together / counts), least)
    variance, rest = _parity(episodes)
    of_poses = (episodes[0].stiffness.numpy() * std[:3]) ** 2
    for axis in np.flatnonzero(of_poses < POSES_SHARE * variance):
        # All rows speak, and little of it has to be taken away.
        std[3 + axis] = max(math.sqrt(variance[axis] - of_poses[axis]), least[3 + axis])
        counts[3 + axis] = rest
    std = std * (1.0 + 1.0 / np.sqrt(2.0 * counts))
    return NoiseEstimate(tuple(std.tolist()), tuple(counts.tolist()))


def check_noise(episode: Episode) -> list[str]:
    """Sentences on stated noise that the data speak against; often none.

    Raises `EpisodeError` where it is plainly too large, and where forces scatter many times more
    than is stated in a way that no effect of arm or sensor does.
    """
    from scipy.stats import binom, chi2

    path = episode.path or Path("the episode")
    stated, readings = episode.sensor_std.numpy(), _readings(episode)
    targets = np.column_stack((episode.commands.numpy(), np.zeros((len(readings), 3))))
    away = np.abs(short_way(readings - targets))[1:]
    repeats = np.abs(short_way(np.diff(episode.commands.numpy(), axis=0))).max(1) <= 1e-9
    alone = ~(repeats | np.append(repeats[1:], False))
    measured = [(name, k, *_ratio(episode, k)) for k, name in enumerate(SENSOR_NAMES)]
    for name, k, ratio, freedom, _ in measured:
        if stated[k] <= 0:
            continue
        step = resolution(readings[:, k]) / stated[k]
        near = int((away[:, k] < NEAR * stated[k]).sum())
        # A normal number is never likelier to come so near to anything, rounded or not.
        share = math.erf((NEAR + step / 2) / math.sqrt(2.0))
        by_share = float(binom.sf(near - 1, len(away), share))
        least = max(_ratio(episode, k, alone=True)[0], step / math.sqrt(12.0))
        by_scatter = float(chi2.cdf(least**2 * freedom, freedom)) if least < TOO_LARGE else 1.0
        together = 1.0
        if k < 3:
            # Poses scatter by the rows of repeats; the others are independent of them.
            others = int((away[alone, k] < NEAR * stated[k]).sum())
            together = _fisher(float(binom.sf(others - 1, alone.sum(), share)), by_scatter)
        if min(by_share, by_scatter, together) < SURE:
            found = (
                f"{near} of {len(away)} rows lie within a fifth of it of where they would be"
                if by_share < by_scatter
                else f"readings scatter by {ratio * stated[k]:.2g}"
            )
            raise EpisodeError(
                path,
                f"sensor_std of {name} is {stated[k]:g}, plainly too large: {found}",
                "give one standard deviation in SI units, or leave sensor_std out for"
                " scripts/diagnose.py to estimate it",
            )
    warnings = _coarse(episode)
    for name, k, ratio, freedom, source in measured:
        p = chi2.sf(ratio**2 * freedom, freedom) if freedom else 1.0
        if stated[k] <= 0 or ratio < TOO_SMALL or p > LIKELY:
            continue
        told = f"sensor_std of {name} is {stated[k]:g}, but {source} by {ratio * stated[k]:.2g}"
        if source == _PARITY and ratio > FAR_TOO_SMALL and p < SURE:
            raise EpisodeError(
                path, f"{told}: plainly too small", "give what the sensor really scatters by"
            )
        warnings.append(f"{told}: it is too small, or the arm creeps or lags")
    return warnings


def _coarse(episode: Episode) -> list[str]:
    """Sentences on channels that were rounded to steps of which the stated noise does not know."""
    found = []
    targets = np.column_stack((episode.commands.numpy(), np.zeros((len(episode), 3))))
    for k, name in enumerate(SENSOR_NAMES):
        column, stated = _readings(episode)[:, k], float(episode.sensor_std[k])
        # Where the arm stands as asked, the steps may be those of the commands.
        column = column[column != targets[:, k]]
        if len(np.unique(column)) < FEWEST_LEVELS or not stated > 0:
            continue
        step = grid_step(column)
        # A value that was rounded is anywhere within its step.
        scatter = step / math.sqrt(12.0)
        whole = (column - column.min()) / step if step > 0 else column
        if scatter < ROUNDED * stated or np.abs(whole - np.round(whole)).max() > 1e-3:
            continue
        both = math.hypot(stated, scatter)
        found.append(
            f"{name} is in steps of {step:.2g}, which scatter it by {scatter:.2g}, but its"
            f" sensor_std is {stated:.2g}: give all digits, or {both:.2g} as sensor_std"
        )
    return found


def noise_findings(episode: Episode) -> list[Finding]:
    """What speaks against the stated noise, as doubts; `check_noise` refuses the gravest."""
    try:
        return [Finding("row", Weight.DOUBT, line) for line in check_noise(episode)]
    except EpisodeError as error:
        return [Finding("row", Weight.DOUBT, error.problem, remedy=error.remedy)]


def _fisher(first: float, second: float) -> float:
    """Probability of two independent ones together (Fisher 1932)."""
    product = max(first * second, 1e-300)
    return product * (1.0 - math.log(product))


_PAUSES, _PARITY = "rows of one command differ", "w - K (x - u) scatters"


def _ratio(episode: Episode, channel: int, alone: bool = False) -> tuple[float, int, str]:
    """Scatter of a channel over what is stated, its degrees of freedom, and where it shows.

    Parity holds the noise of pose and wrench, independent of each other; with `alone` that of the
    wrench only, since an arm that makes its spring from the force sensor has them correlated.
    """
    stated = episode.sensor_std.numpy()
    if channel >= 3:
        variance, freedom = _parity([episode])
        axis = channel - 3
        pose = 0.0 if alone else float(episode.stiffness[axis] * stated[axis])
        expected = stated[channel] ** 2 + pose**2
        if freedom > CURVES and expected > 0:
            return math.sqrt(variance[axis] / expected), freedom, _PARITY
    squares, freedom = _pauses([episode])
    if not freedom or stated[channel] <= 0:
        return 1.0, 0, _PAUSES
    return math.sqrt(squares[channel] / freedom) / stated[channel], freedom, _PAUSES


def _pauses(episodes: Sequence[Episode]) -> tuple[Float[np.ndarray, " 6"], int]:
    """Squares of what rows of one command, given again and again, depart from their mean by."""
    squares, freedom = np.zeros(6), 0
    for episode in episodes:
        commands, readings = episode.commands.numpy(), _readings(episode)
        changes = np.abs(short_way(np.diff(commands, axis=0))).max(1) > 1e-9
        groups = np.split(np.arange(len(readings)), np.flatnonzero(changes) + 1)
        for rows in groups:
            # The start row's command is the measured pose.
            rows = rows[rows > 0]
            if len(rows) > 1:
                part = readings[rows]
                part = part[0] + short_way(part - part[0])
                squares += ((part - part.mean(0)) ** 2).sum(0)
                freedom += len(rows) - 1
    return squares, freedom


def _parity(episodes: Sequence[Episode]) -> tuple[Float[np.ndarray, " 3"], int]:
    """Variance of w - K (x - u) about what smooth effects of arm and sensor leave there."""
    squares, freedom = np.zeros(3), 0
    for episode in episodes:
        away, wrenches = _away(episode)[1:], episode.wrenches.numpy()[1:]
        moved = short_way(np.diff(episode.commands.numpy(), axis=0))
        if len(away) <= CURVES:
            continue
        residual = wrenches - episode.stiffness.numpy() * away
        ones, time = np.ones(len(away)), np.linspace(-1.0, 1.0, len(away))
        for axis in range(3):
            step = moved[:, axis]
            design = np.column_stack((ones, time, away, step, np.sign(step)))
            scale = np.abs(design).max(0)
            fitted = design / np.where(scale > 0, scale, 1.0)
            left = (
                residual[:, axis]
                - fitted @ np.linalg.lstsq(fitted, residual[:, axis], rcond=None)[0]
            )
            squares[axis] += left @ left
        freedom += len(away) - CURVES
    return squares / max(freedom, 1), freedom


def _readings(episode: Episode) -> Float[np.ndarray, "n 6"]:
    return torch.cat((episode.poses, episode.wrenches), dim=-1).numpy()


def _away(episode: Episode) -> Float[np.ndarray, "n 3"]:
    return short_way((episode.poses - episode.commands).numpy())
