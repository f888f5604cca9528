"""What contact says about theta, as rows of linear equations in units of their deviations.

Rows are over the six entries of `LINEAR`: scale, mount x and z, friction, floor height, wall
position. Terrain 0 is the floor, 1 the wall; r rows, n transitions, t terrains.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.belief.history import History

LINEAR = ("scale", "mount_x", "mount_z", "friction", "floor_height", "wall_position")
"""The entries that readings are linear in."""
ROLLING_SD = 3e-4
"""What a rolling contact leaves besides noise [m]: the simulator rolls in parts."""
LEAST_TURN = 0.02
"""Turns [rad] below which rolling says nothing that is not said elsewhere."""
SLIDING_SD = 0.01
"""What sliding leaves besides noise, as a share of the normal force."""


def rolling_rows(
    history: History, touched: Bool[Tensor, "n t"], stuck: Bool[Tensor, "n t"]
) -> tuple[Float[Tensor, "r 6"], Float[Tensor, " r"]]:
    """Where both ends of a transition are on a terrain, and it stuck there."""
    start, end = history.start, history.settled
    turn = end[:, 2] - start[:, 2]
    before = torch.zeros_like(touched)
    before[1:] = touched[:-1]
    rolls = stuck & touched & before & (turn.abs() > LEAST_TURN)[:, None]
    row, terrain = torch.nonzero(rolls, as_tuple=True)
    normal = terrain_normals(history)[terrain]
    along, turn = along_terrain(normal), turn[row]
    moved = ((end - start)[row, :2] * along).sum(-1)
    height = (0.5 * (end + start)[row, :2] * normal).sum(-1)
    variance = (history.variance[1:] + history.variance[:-1])[row, :2]
    sd = ((variance * along**2).sum(-1) + ROLLING_SD**2).sqrt()
    rows = normal.new_zeros(len(row), 6)
    rows[:, 4:] = -turn[:, None] * offset_signs(terrain, rows)
    return rows / sd[:, None], -(moved + turn * height) / sd


def sliding_rows(
    history: History, touched: Bool[Tensor, "n t"], stuck: Bool[Tensor, "n t"]
) -> tuple[Float[Tensor, "r 6"], Float[Tensor, " r"]]:
    """Where one terrain alone holds the object, and does not hold it fast."""
    row, terrain = torch.nonzero(touched & ~stuck & (touched.sum(-1) == 1)[:, None], as_tuple=True)
    normal = terrain_normals(history)[terrain]
    along = along_terrain(normal)
    stiffness = history.stiffness[:2]
    force = stiffness * (history.settled - history.command)[row, :2]
    variance = stiffness**2 * history.variance[1:][row, :2]
    pressing = (force * normal).sum(-1).clamp_min(1e-3)
    drag = (force * along).sum(-1).abs()
    noise = (variance * along**2).sum(-1) + (drag / pressing) ** 2 * (variance * normal**2).sum(-1)
    sd = (noise + (SLIDING_SD * pressing) ** 2).sqrt()
    rows = normal.new_zeros(len(row), 6)
    rows[:, 3] = pressing / sd
    return rows, drag / sd


def terrain_normals(history: History) -> Float[Tensor, "2 2"]:
    """Of floor and wall, out of the terrain."""
    return history.poses.new_tensor([[0.0, 1.0], [-1.0, 0.0]])


def along_terrain(normal: Float[Tensor, "r 2"]) -> Float[Tensor, "r 2"]:
    """The normals turned by -90 degrees: to the right on the floor, upwards on the wall."""
    return normal.flip(-1) * normal.new_tensor([1.0, -1.0])


def offset_signs(terrains: Int[Tensor, " r"], like: Tensor) -> Float[Tensor, "r 2"]:
    """Derivative (c, 2) of the offset along the normal by floor height and wall position."""
    return torch.where(
        torch.nn.functional.one_hot(terrains, 2).bool(), like.new_tensor([1.0, -1.0]), 0.0
    )
