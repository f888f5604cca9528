"""What an arm can feel of floor and wall from where it stopped short of its command.

Contact is felt through the impedance, K (pose - command) [N], which the position sensors
give a hundred times more finely than the force sensor, and without its errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.truth.motions import LARGEST_FRICTION, TOUCH_FORCE, History

FLAT = 0.04
"""Up to this angle, a pose tells where floor and wall are for the upright object [rad]."""
FELT = 0.6
"""Force beyond which the impedance feels contact where floor or wall are known to be [N]."""
NEAR = 0.008
"""How far floor or wall may be from where they were met last, by tilt or drift [m]."""
USUAL_FRICTION = 0.5
"""Taken until the floor is slid on; the wall is taken to be like the floor."""
SLID = 0.005
"""A row in which the hand moved by more than this along a surface tells its friction [m]."""

Command = tuple[float, float, float]


@dataclass(frozen=True)
class Feel:
    """What a history says about the world, lengths in metres, of the hand and upright."""

    x: float
    z: float
    command: Command
    floor_z: float
    """Height of the hand on the floor."""
    wall_x: float
    """Place of the hand at the wall; the furthest so far until the wall is met."""
    on_floor: bool
    at_wall: bool
    floor_friction: float
    wall_friction: float
    stiffness: tuple[float, float]
    """Along x and z [N/m]."""


def feel(history: History) -> Feel:
    """Read the last row, and where and how rough floor and wall are, from all rows."""
    stiffness = history.stiffness[:2]
    forces = stiffness * (history.poses - history.commands)[:, :2]
    floor_z = wall_x = None
    on_floor, at_wall = [], []
    for (x, z, angle), (left, up) in zip(
        history.poses.tolist(), (forces * torch.tensor([-1.0, 1.0])).tolist(), strict=True
    ):
        upright = abs(angle) < FLAT
        # Off the floor, what pushes up is friction of the wall.
        is_low = floor_z is None or z < floor_z + NEAR
        floored = up > FELT and is_low
        drag = LARGEST_FRICTION * up if floored else 0.0
        if wall_x is None:
            walled = left > drag + TOUCH_FORCE
        else:
            walled = left > drag + FELT and x > wall_x - NEAR
        on_floor.append(floored and upright)
        at_wall.append(walled and upright)
        if on_floor[-1] and (floor_z is None or not walled or z < floor_z):
            floor_z = z
        if at_wall[-1]:
            wall_x = x
    x, z, _ = history.poses.T
    floored, walled = torch.tensor(on_floor), torch.tensor(at_wall)
    along_x, along_z = forces.T
    floor_friction = _friction(along_x, along_z, x, floored, floored & ~walled, USUAL_FRICTION)
    return Feel(
        x=float(x[-1]),
        z=float(z[-1]),
        command=as_command(history.commands[-1]),
        floor_z=float(z.min()) if floor_z is None else floor_z,
        wall_x=float(x.max()) if wall_x is None else wall_x,
        on_floor=on_floor[-1],
        at_wall=at_wall[-1],
        floor_friction=floor_friction,
        wall_friction=_friction(along_z, along_x, z, walled, walled & ~floored, floor_friction),
        stiffness=(float(stiffness[0]), float(stiffness[1])),
    )


def as_command(row: Float[Tensor, " 3"]) -> Command:
    """A row as plain numbers x, z, phi [m, m, rad]."""
    x, z, angle = row.tolist()
    return x, z, angle


def _friction(
    tangential: Tensor,
    normal: Tensor,
    position: Tensor,
    touching: Tensor,
    alone: Tensor,
    otherwise: float,
) -> float:
    """Median ratio in the rows that slid along one surface, not touching the other."""
    slid = alone[1:] & touching[:-1] & (position.diff().abs() > SLID)
    if not bool(slid.any()):
        return otherwise
    ratio = (tangential[1:][slid] / normal[1:][slid]).abs()
    return float(ratio.median().clamp(0.05, 1.3))
