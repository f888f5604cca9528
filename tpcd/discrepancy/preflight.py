"""Two tests of a recording that need no theta and no model of contact.

Parity, w - K (x - u), tells effects of the arm and of the sensors from all others. In free space
the pose is the command: payload, friction of the arm and lag show there.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from tpcd.belief.history import History
from tpcd.data.episode import Episode
from tpcd.discrepancy.coverage import contact_rows
from tpcd.planar import wrap_angle

CLEAR = 0.012
"""So far from where anything met resistance a row is free [m]."""
FEWEST = 4
"""Free rows that are needed."""


def parity_score(history: History) -> tuple[float, float]:
    """Mean parity chi-square for each degree of freedom, and its probability under the noise
    that is stated; needs no theta."""
    square = history.merged.chi_square[0][history.read]
    return float(square.mean()) / 3, _chi_square_p(float(square.sum()), 3 * len(square))


def free_space_score(episodes: Sequence[Episode]) -> tuple[float, float, int] | None:
    """Mean chi-square of pose minus command for each degree of freedom where nothing touches,
    its probability, and the number of rows; None where too few are sure to be free.

    Needs no theta: rows clear of all that met resistance. Payload, friction of the arm and lag
    show in it, contact does not.
    """
    squares = []
    for episode in episodes:
        floored, walled = contact_rows(episode)
        x, z, _ = episode.poses.T
        alone = floored & ~walled  # beside the wall, friction pushes up too
        if not bool(alone.any()):
            continue
        free = (z > z[alone].max() + CLEAR) & ~walled
        if bool(walled.any()):
            free &= x < x[walled].min() - CLEAR
        away = episode.poses - episode.commands
        away = torch.cat((away[:, :2], wrap_angle(away[:, 2:])), dim=-1)
        free[0] = False  # the command of the start is its pose
        squares.append((away / episode.sensor_std[:3]).square().sum(-1)[free])
    square = torch.cat(squares) if squares else torch.zeros(0)
    if len(square) < FEWEST:
        return None
    p = _chi_square_p(float(square.sum()), 3 * len(square))
    return float(square.mean()) / 3, p, len(square)


def _chi_square_p(total: float, freedom: int) -> float:
    half = torch.tensor(freedom / 2.0, dtype=torch.float64)
    return float(torch.special.gammaincc(half, torch.tensor(total / 2.0, dtype=torch.float64)))
