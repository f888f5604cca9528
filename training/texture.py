"""The texture of outline errors: what predicts an error at other angles best from readings of it.

An episode turns an object back and forth in a window of angles, and a few noisy readings of gap and
lever are what an estimator learns of the error there. So the texture is chosen by its task: in many
windows of many outlines the error e and its slope e' are read at some angles, with the noise of
sensors, and predicted at others with the model of the estimator (`tpcd.belief.misfit`),

    e(a) = sd (smooth(a) + grain n),    e'(a) = sd (smooth'(a) + roughness n'),

where smooth is a Gaussian process with correlation exp(-(a - b)^2 / (4 width^2)), n and n' are
normal and new at each reading, and sd is log-normal and learnt from the readings. Width, grain and
roughness have the greatest mean log density of what is to be predicted (the logarithmic score, see
Gneiting and Raftery 2007), in equal shares of the groups of outlines.

Mean squares over all angles would not do: most windows are smooth, while a few, where a nearly
flat face touches, jump. Such a mean is wrong for both, and intervals from it are too wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int
from scipy.optimize import minimize
from torch import Tensor

WINDOWS, REACH = 8, 0.15
"""Windows of each outline, and how far a window reaches to both sides [rad]."""
READINGS, TARGETS = 8, 8
"""Angles of a window that are read, and those that are predicted."""
GAP_NOISE, LEVER_NOISE = 0.2, 5.0
"""Noise of a reading [mm]: that of positions, and that of a torque over the force of a contact."""
RESOLUTION = 1e-3
"""Smaller errors than this do not matter [mm]."""
_SCORES = torch.linspace(-3.5, 3.5, 36, dtype=torch.float64)
_LEAST, _MOST = (0.02, 1e-4, 1e-2), (2.0, 2.0, 100.0)
_START = (0.15, 0.05, 2.0)


@dataclass(frozen=True)
class Texture:
    """What an outline error is like, relative to its size."""

    width: float
    """Width of the correlation [rad]."""
    grain: float
    """Standard deviation of what is new at each reading, as a share of that of the smooth part."""
    roughness: float
    """The same of the slope [1/rad]."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Errors and slopes of w windows [mm], at r angles that are read and t that are predicted."""

    angles: Float64[Tensor, "w r+t"]
    read: Float64[Tensor, "w 2*r"]
    """Readings of the error, then of its slope; with noise."""
    wanted: Float64[Tensor, "w 2*t"]
    """What is to be predicted; without noise."""
    group: Int[Tensor, " w"]
    """The group of outlines of each window."""


def fit_texture(windows: Windows, median: float, spread: float) -> Texture:
    """The texture of the best score, for errors of a log-normal size: `median` [mm] is that of
    error and grain together, `spread` the standard deviation of the logarithm."""
    groups = windows.group.unique()

    def loss(logs: np.ndarray) -> float:
        log_density, _ = score(windows, Texture(*np.exp(logs)), median, spread)
        each = log_density.mean(-1)
        return -float(torch.stack([each[windows.group == group].mean() for group in groups]).mean())

    found = minimize(
        loss,
        np.log(_START),
        method="Nelder-Mead",
        bounds=list(zip(np.log(_LEAST), np.log(_MOST), strict=True)),
        options={"xatol": 0.01, "fatol": 1e-4, "maxiter": 200},
    )
    return Texture(*(float(value) for value in np.exp(found.x)))


def draw_windows(
    groups: Sequence[Sequence[Float64[np.ndarray, "2 k"]]], rng: np.random.Generator
) -> Windows:
    """Windows anywhere on the outlines of each group, of which error and slope are known at k
    angles all around [mm]."""
    angles, errors, owners = [], [], []
    for group, outlines in enumerate(groups):
        for outline in outlines:
            step = 2 * np.pi / outline.shape[-1]
            middle = rng.integers(outline.shape[-1], size=(WINDOWS, 1))
            away = rng.uniform(-REACH, REACH, (WINDOWS, READINGS + TARGETS))
            away = np.round(away / step).astype(int)
            angles.append(away * step)
            errors.append(outline[:, (middle + away) % outline.shape[-1]])
            owners.append(np.full(WINDOWS, group))
    value, slope = np.concatenate(errors, axis=1)
    noise = rng.standard_normal((2, len(value), READINGS))
    read = (
        value[:, :READINGS] + GAP_NOISE * noise[0],
        slope[:, :READINGS] + LEVER_NOISE * noise[1],
    )
    wanted = (value[:, READINGS:], slope[:, READINGS:])
    return Windows(
        torch.from_numpy(np.concatenate(angles)),
        torch.from_numpy(np.concatenate(read, axis=1)),
        torch.from_numpy(np.concatenate(wanted, axis=1)),
        torch.from_numpy(np.concatenate(owners)),
    )


def score(
    windows: Windows, texture: Texture, median: float, spread: float
) -> tuple[Float64[Tensor, "w 2*t"], Float64[Tensor, "w 2*t"]]:
    """Log density and distribution function of each wanted error and slope, given the readings of
    its window; a mixture over sizes of the error."""
    r, t = READINGS, windows.angles.shape[1] - READINGS
    prior = _covariance(windows.angles, texture.width)
    among = torch.cat((torch.arange(r), r + t + torch.arange(r)))
    others = torch.cat((torch.arange(r, r + t), 2 * r + t + torch.arange(t)))
    own = torch.tensor((texture.grain**2, texture.roughness**2), dtype=torch.float64)
    noise = torch.tensor((GAP_NOISE, LEVER_NOISE), dtype=torch.float64).repeat_interleave(r)
    # In units of the noise one decomposition serves all sizes.
    covariance = prior[:, among[:, None], among] + torch.diag(own.repeat_interleave(r))
    power, axes = torch.linalg.eigh(covariance / (noise[:, None] * noise))
    read = (axes.mT @ (windows.read / noise)[..., None])[..., 0]
    shared = (prior[:, others[:, None], among] / noise) @ axes
    square = (median / math.hypot(1, texture.grain) * torch.exp(spread * _SCORES)) ** 2
    square = square[:, None, None]
    total = square * power.clamp_min(0.0) + 1
    evidence = -0.5 * (read**2 / total + total.log()).sum(-1) - 0.5 * _SCORES[:, None] ** 2
    weights = torch.softmax(evidence, dim=0)[..., None]
    mean = square * torch.einsum("wtj,swj->swt", shared, read / total)
    alone = prior.diagonal(dim1=1, dim2=2)[:, others] + own.repeat_interleave(t)
    variance = square * alone - square**2 * torch.einsum("wtj,swj->swt", shared**2, 1 / total)
    sd = (variance.clamp_min(0.0) + RESOLUTION**2).sqrt()
    away = (windows.wanted - mean) / sd
    density = -0.5 * away**2 - sd.log() - 0.5 * math.log(2 * math.pi)
    log_density = torch.logsumexp(density + weights.log(), dim=0)
    return log_density, (weights * torch.special.ndtr(away)).sum(0)


def _covariance(angles: Float64[Tensor, "w n"], width: float) -> Float64[Tensor, "w 2*n 2*n"]:
    """Of the smooth part at n angles, and of its slope there."""
    apart = angles[:, :, None] - angles[:, None, :]
    values = torch.exp(-(apart**2) / (4 * width**2))
    mixed = values * apart / (2 * width**2)
    slopes = values * (1 / (2 * width**2) - apart**2 / (4 * width**4))
    return torch.cat((torch.cat((values, mixed), -1), torch.cat((mixed.mT, slopes), -1)), 1)
