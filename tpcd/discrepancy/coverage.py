"""Preflight: what an episode excites, so which effects it could show at all.

Contact is read from the impedance, K (pose - command), which needs no force sensor: a force up
is the floor; a force to the left beyond what friction on the floor could give is the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.effects.excitations import NEEDED, UNITS
from tpcd.truth.motions import LARGEST_FRICTION, TOUCH_FORCE

MOVED = 0.005
"""A row that moved further than this along a surface slid on it [m]."""
LEVEL = 0.004
"""A hand this much higher than wherever the floor held it does not touch it [m]."""
STILL = 0.001
"""A row that moved less than this stuck to it [m]."""


@dataclass(frozen=True)
class Coverage:
    """What some episodes excite."""

    counts: dict[str, float]
    """How much there is of each excitation of `NEEDED`."""

    def missing(self, needs: Sequence[str]) -> list[str]:
        """Those of the needs that are not met."""
        return [need for need in needs if self.counts.get(need, 0.0) < NEEDED.get(need, 1.0)]


def coverage_of(episodes: Sequence[Episode]) -> Coverage:
    """What the episodes excite together; each is one run of its own."""
    found = [_of_one(episode) for episode in episodes]
    return Coverage(
        {
            need: (sum if UNITS[need] == "rows" else max)(one[need] for one in found)
            for need in NEEDED
        }
    )


def contact_rows(episode: Episode) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
    """Rows in contact with the floor, and with the wall.

    A force up and within the floor's friction cone is the floor, which says how high it is. A
    force up from higher than that is friction of the wall.
    """
    force, height = _force(episode), episode.poses[:, 1]
    up = force[:, 1] > TOUCH_FORCE / 2
    floor_alone = up & (force[:, 0].abs() <= LARGEST_FRICTION * force[:, 1])
    if bool(floor_alone.any()):
        up &= height <= height[floor_alone].max() + LEVEL
    drag = torch.where(up, LARGEST_FRICTION * force[:, 1], 0.0)
    return up, -force[:, 0] > drag + TOUCH_FORCE / 2


def _of_one(episode: Episode) -> dict[str, float]:
    force = _force(episode)
    floored, walled = contact_rows(episode)
    free = ~floored & ~walled
    move = torch.zeros_like(episode.poses)
    move[1:] = episode.poses[1:] - episode.poses[:-1]
    change = torch.zeros_like(force)
    change[1:] = force[1:] - force[:-1]
    asked = torch.zeros_like(move)
    asked[1:] = episode.commands[1:] - episode.commands[:-1]
    on_floor, on_wall = (_both(rows) for rows in (floored & ~walled, walled & ~floored))
    right, left = (on_floor & (side * move[:, 0] > MOVED) for side in (1, -1))
    still = asked.abs().amax(-1) < 1e-9
    still[0] = False
    stuck = on_floor & (move[:, 0].abs() < STILL) & (change[:, 0].abs() > 0.3)
    left_floor = torch.zeros_like(free)
    left_floor[1:] = floored[:-1] & (force[1:, 1] < TOUCH_FORCE / 4)
    counts = {
        "free motion": free & (move[:, :2].norm(dim=-1) > 2 * MOVED),
        "pause": still,
        "lift-off": left_floor,
        "floor load": floored,
        "floor slip": right | left,
        "floor stick": stuck,
        "wall load": walled,
        "wall slip": on_wall & (move[:, 1].abs() > MOVED),
    }
    result = {name: float(rows.sum()) for name, rows in counts.items()}
    result["floor slip both ways"] = float(min(right.sum(), left.sum()))
    result["floor loads"] = _ratio(force[floored, 1])
    result["wall loads"] = _ratio(-force[walled, 0])
    result["floor places"] = _span(episode.poses[floored, 0])
    result["wall places"] = _span(episode.poses[walled, 1])
    return result


def _force(episode: Episode) -> Float[Tensor, "n 2"]:
    return (episode.stiffness * (episode.poses - episode.commands))[:, :2]


def _both(rows: Tensor) -> Tensor:
    """Rows that are in contact like the row before."""
    both = rows.clone()
    both[0] = False
    both[1:] &= rows[:-1]
    return both


def _ratio(loads: Tensor) -> float:
    """Largest to smallest, without the outermost tenths."""
    if len(loads) < 3:
        return 0.0
    low, high = torch.quantile(loads, torch.tensor([0.1, 0.9], dtype=loads.dtype)).tolist()
    return high / max(low, 0.1)


def _span(places: Tensor) -> float:
    return float(places.max() - places.min()) if len(places) > 1 else 0.0
