"""A palm that pivots an object on a table under impedance control, as an episode in its plane.

The recordings (Doshi, Taylor and Rodriguez, arXiv 2203.01203) give the palm by d, s and theta from
the object's pivot. In the vertical plane of the arm's base, x forward and z up,

    x = p_x - d sin(theta) - s cos(theta),    z = p_z - d cos(theta) + s sin(theta),

with theta clockwise, so phi = -theta. No force was recorded: the wrench is K (x - u), and tells
nothing that the pose does not.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from tpcd.data.episode import Episode

NOTES = (
    "Eight recordings of one held command each, while the palm that was let go off its target comes"
    " to rest: eight rows, put ten seconds apart. No force was recorded: the wrench is K (x - u).",
    "Nothing begins free, so the import refuses them. For estimate and diagnosis an episode was"
    " made with a free start that is assumed, the palm above the first row; its notes say so.",
    "The object slips and pivots in the palm, so that a rigid grasp is false.",
)
LAST = 0.5
"""Seconds at the end of a recording that make its row, as in an import."""
HEIGHT = 0.1
"""How far above the first row the assumed free start lies [m]."""


@dataclass(frozen=True, eq=False)
class Held:
    """One recording: a command that is held while the palm comes to rest."""

    times: Float[np.ndarray, " n"]
    """[s]"""
    contact: Float[np.ndarray, "n 3"]
    """(d, s, theta) [m, m, rad]."""
    command: Float[np.ndarray, " 3"]
    """(x, z, phi) [m, m, rad]."""
    stiffness: Float[np.ndarray, " 3"]
    pivot: Float[np.ndarray, " 2"]
    """Where the object turns on the table [m]."""
    moment: float
    """Weight times lever of the object [N·m]."""
    upright: float
    """theta at which its centre of mass is over the pivot [rad]."""

    def poses(self, mirror: Sequence[float] = (1.0, 1.0)) -> Float[np.ndarray, "n 3"]:
        """Palm in the plane (x, z, phi) [m, m, rad]; `mirror` gives theta and s other signs."""
        turn, slide = mirror
        d, s, theta = self.contact[:, 0], slide * self.contact[:, 1], turn * self.contact[:, 2]
        x = self.pivot[0] - d * np.sin(theta) - s * np.cos(theta)
        z = self.pivot[1] - d * np.cos(theta) + s * np.sin(theta)
        return np.stack((x, z, -theta), axis=1)

    def settled(self) -> np.ndarray:
        """Which samples make the row."""
        return self.times >= self.times[-1] - LAST

    def moment_left(self, mirror: Sequence[float] = (1.0, 1.0)) -> float:
        """What the springs and the object's weight leave about the pivot at rest, the way theta
        grows [N·m]: friction and the table hold it. 0 in equilibrium without either."""
        kept = self.settled()
        pose, theta = self.poses(mirror)[kept].mean(0), self.contact[kept, 2].mean()
        command = self.command * [1.0, 1.0, mirror[0]]
        force = self.stiffness * (command - pose)
        lever = pose[:2] - self.pivot
        turning = lever[0] * force[1] - lever[1] * force[0] + mirror[0] * force[2]
        return float(-turning + self.moment * np.sin(theta - self.upright))


def read_held(path: Path) -> Held:
    """One recording with its command."""
    content = json.loads(path.read_text(encoding="utf-8"))
    given, about = content["param_dict"], content["param_dict"]["obj_params"]
    return Held(
        np.array(content["time"]),
        np.array(content["estimated"]),
        np.array(given["impedance_target"]) * [1.0, 1.0, -1.0],
        np.array(given["impedance_stiffness"], dtype=float),
        np.array(about["pivot"]),
        float(about["mgl"]),
        float(about["theta0"]),
    )


def joined(held: Sequence[Held]) -> dict[str, np.ndarray]:
    """All recordings one after the other, ten seconds apart, as a planar table."""
    parts, begun = [], 0.0
    for one in held:
        poses = one.poses()
        commands = np.broadcast_to(one.command, poses.shape)
        wrenches = one.stiffness * (poses - commands)
        times = (begun + one.times - one.times[0])[:, None]
        parts.append(np.concatenate((times, poses, commands, wrenches), axis=1))
        begun = times[-1, 0] + 10.0
    names = ("time", "x", "z", "phi", "u_x", "u_z", "u_phi", "F_x", "F_z", "tau")
    return dict(zip(names, np.concatenate(parts).T, strict=True))


def episode(held: Sequence[Held]) -> Episode:
    """A row of each recording after a free start that is assumed and was not recorded."""
    rows = np.array([one.poses()[one.settled()].mean(0) for one in held])
    commands = np.array([one.command for one in held])
    stiffness = held[0].stiffness
    scatter = np.array([one.poses()[one.settled()].std(0) for one in held])
    noise = np.sqrt((scatter**2).mean(0))
    start = rows[:1] + [0.0, HEIGHT, 0.0]
    wrenches = stiffness * (rows - commands)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))

    return Episode(
        commands=tensor(np.concatenate((start, commands))),
        poses=tensor(np.concatenate((start, rows))),
        wrenches=tensor(np.concatenate((np.zeros((1, 3)), wrenches))),
        stiffness=tensor(stiffness),
        sensor_std=tensor(np.concatenate((noise, stiffness * noise))),
        notes="row 0 was not recorded: the palm is taken as free above the first row; wrenches are"
        " K (x - u), computed and not measured",
        priors={"floor_height": (-0.01, 0.01), "wall_position": (0.9, 1.0)},
    )
