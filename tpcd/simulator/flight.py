"""Free flight: how far the object follows the command before it first touches something.

Away from contact an impedance-controlled arm settles on its command, so the motion from a
free start is the straight line from pose to command. Friction acts only from the first
touch on; starting the contact step there spares most substeps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.contact import ContactScene, contact_frame
from tpcd.simulator.lowest import lowest_points

FREE_GAP = 1e-5
"""A start pose flies when every gap exceeds this [m]."""
BISECTIONS = 12
"""Rounds of the bracketing search; each at least halves the bracket, most do far better."""


@dataclass(frozen=True)
class Flight:
    """Where the first touch happens on the way from start to command.

    `fraction` of the way in [0, 1] (0: already touching, 1: the command is reached freely),
    `point` and `terrain` of the first touch.
    """

    fraction: Float[Tensor, " b"]
    point: Int[Tensor, " b"]
    terrain: Int[Tensor, " b"]


def first_touch(
    scene: ContactScene, start: Float[Tensor, "b 3"], command: Float[Tensor, "b 3"]
) -> Flight:
    """Find the largest fraction of the way that is free, by false position (Illinois)."""
    with torch.no_grad():
        gap_start, _, _ = _lowest(scene, start)
        gap_end, point, terrain = _lowest(scene, command)
        flies = gap_start > FREE_GAP
        fraction = (flies & (gap_end >= 0)).to(start.dtype)
        index = torch.nonzero(flies & (gap_end < 0)).flatten()
        part, start, way = scene.gather(index), start[index], (command - start)[index]
        low, high = torch.zeros_like(gap_start[index]), torch.ones_like(gap_start[index])
        value_low, value_high = gap_start[index], gap_end[index]
        last_side = torch.zeros_like(low)
        for _ in range(BISECTIONS):
            if len(index) == 0:
                break
            trial = (low * value_high - high * value_low) / (value_high - value_low)
            trial = torch.where(torch.isfinite(trial), trial, 0.5 * (low + high))
            gap, point[index], terrain[index] = _lowest(part, start + trial[:, None] * way)
            free = gap >= 0
            value_high = torch.where(free & (last_side > 0), 0.5 * value_high, value_high)
            value_low = torch.where(~free & (last_side < 0), 0.5 * value_low, value_low)
            low, value_low = torch.where(free, trial, low), torch.where(free, gap, value_low)
            high, value_high = torch.where(free, high, trial), torch.where(free, value_high, gap)
            last_side = torch.where(free, 1.0, -1.0).to(gap)
            fraction[index] = low
            kept = torch.nonzero((value_low > 1e-9) & (high - low > 1e-9)).flatten()
            if len(kept) < len(index):
                index, part, start, way = index[kept], part.gather(kept), start[kept], way[kept]
                low, high, last_side = low[kept], high[kept], last_side[kept]
                value_low, value_high = value_low[kept], value_high[kept]
        return Flight(fraction, point, terrain)


def touch_row(
    scene: ContactScene, pose: Float[Tensor, "b 3"], flight: Flight
) -> tuple[Float[Tensor, " b"], Float[Tensor, "b 3"]]:
    """Gap of the first-touching point at `pose` [m] and its derivative with respect to the pose."""
    gap = torch.zeros_like(flight.fraction)
    row = pose.new_zeros(pose.shape)
    for t, body in enumerate(scene.terrains):
        frame = contact_frame(scene.points_ee, body, pose, flight.point[:, None])
        here = flight.terrain == t
        gap = torch.where(here, frame.gap[:, 0], gap)
        row = torch.where(here[:, None], frame.normal_row[:, 0], row)
    return gap, row


def _lowest(scene: ContactScene, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    gaps, points = lowest_points(scene, pose, pose.new_zeros(*scene.friction.shape, 1))
    lowest, terrain = gaps[..., 0].min(-1)
    return lowest, points[..., 0].gather(1, terrain[:, None])[:, 0], terrain
