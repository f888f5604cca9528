"""How outlines differ from their best fits, as contact feels it: `tpcd.shape.protocol.Misfit`.

Whether the object in the hand is one that the prior knows, nobody tells. So the misfit is that of
training outlines and of unseen ones, in equal shares. Of its size, logarithms of the two have their
common mean and standard deviation; its texture predicts errors of both best (`training.texture`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from tpcd.shape.protocol import Misfit
from training.texture import draw_windows, fit_texture, score

LEAST_ERROR = 1e-3
"""Smaller errors count as this [mm]; the logarithm of an exact fit is not finite."""
LEVELS = (0.5, 0.9)
GROUPS = ("unseen", "known")


@dataclass(frozen=True)
class MisfitReport:
    """The misfit, and whether errors of outlines are predicted by it as well as it says."""

    misfit: Misfit
    held: dict[str, dict[str, float]]
    """Shares of gaps and of levers that lie in their 50 and 90 % intervals, by group of outlines:
    in other windows than those by which the texture was chosen."""


def measure_misfit(
    unseen: Sequence[Float64[np.ndarray, "2 k"]],
    known: Sequence[Float64[np.ndarray, "2 k"]],
    seed: int = 0,
) -> MisfitReport:
    """Size and texture of the misfit from differences of support functions and their slopes, all
    around [mm]: those of best fits to unseen outlines and those of training outlines."""
    groups = (unseen, known)
    if not all(groups):
        raise ValueError(
            f"got {len(unseen)} unseen and {len(known)} training outlines, expected some of both"
        )
    logs = [np.log([root_mean_square(error[0]) for error in group]) for group in groups]
    mean = np.mean([group.mean() for group in logs])
    spread = float(np.mean([np.square(group - mean).mean() for group in logs])) ** 0.5
    median = float(np.exp(mean))
    rng = np.random.default_rng(seed)
    texture = fit_texture(draw_windows(groups, rng), median, spread)
    fresh = draw_windows(groups, rng)
    place = score(fresh, texture, median, spread)[1].unflatten(1, (2, -1))
    held = {
        group: {
            f"{name}_{level:.0%}": _within(place[fresh.group == number, channel], level)
            for channel, name in enumerate(("gap", "lever"))
            for level in LEVELS
        }
        for number, group in enumerate(GROUPS)
    }
    sd = median / float(np.hypot(1, texture.grain)) / 1000.0
    return MisfitReport(Misfit(sd, spread, **vars(texture)), held)


def root_mean_square(error_mm: Float64[np.ndarray, " k"]) -> float:
    """Root mean square of an error [mm], at least `LEAST_ERROR`."""
    return max(float(np.sqrt(np.square(error_mm).mean())), LEAST_ERROR)


def _within(place: Float64[torch.Tensor, "w t"], level: float) -> float:
    inside = (place - 0.5).abs() < level / 2
    return round(float(inside.double().mean()), 3)
