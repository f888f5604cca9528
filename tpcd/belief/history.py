"""What has been measured so far, in the form the likelihood wants.

A settled row carries the pose twice: measured directly, and through the wrench, since
w = K (x' - u). The two are merged into one estimate of the settled pose with diagonal
covariance (inverse-variance weights). What they disagree about, the parity residual
w - K (x - u), holds no information on theta but tells a bad reading from a good one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.planar import wrap_angle

PARITY_LIMIT = 16.3
"""Parity chi-square (3 degrees of freedom) beyond which a reading counts as bad: 0.1 %."""


@dataclass(frozen=True)
class History:
    """n transitions between n + 1 settled poses, each estimated from pose and wrench together.

    Poses and commands (x, z, angle) [m, m, rad]; `variance` of the poses in their squares.
    """

    poses: Float[Tensor, "rows 3"]
    variance: Float[Tensor, "rows 3"]
    commands: Float[Tensor, "rows 3"]
    stiffness: Float[Tensor, " 3"]

    def __len__(self) -> int:
        """Number of transitions n."""
        return len(self.poses) - 1

    @property
    def start(self) -> Float[Tensor, "n 3"]:
        """Estimated start pose of each transition."""
        return self.poses[:-1]

    @property
    def previous(self) -> Float[Tensor, "n 3"]:
        """Command at which the arm rested in the start pose."""
        return self.commands[:-1]

    @property
    def command(self) -> Float[Tensor, "n 3"]:
        """Command of each transition."""
        return self.commands[1:]

    @property
    def settled(self) -> Float[Tensor, "n 3"]:
        """Estimated pose at the end of each transition."""
        return self.poses[1:]

    def first(self, count: int) -> History:
        """The first transitions only."""
        last = count + 1
        return History(
            self.poses[:last], self.variance[:last], self.commands[:last], self.stiffness
        )


def history_of(episode: Episode, least_std: float = 2e-5) -> History:
    """The transitions of an episode: row k explains how row k - 1 went over to it.

    `least_std` [m, m, rad] is added to the noise of poses, in quadrature: what the numerics
    of any simulator leave.
    """
    stiffness = episode.stiffness.double()
    poses, commands = episode.poses.double(), episode.commands.double()
    variance = episode.sensor_std.double() ** 2 + least_std**2
    pose_variance = variance[:3]
    wrench_variance = variance[3:] / stiffness**2
    offset = _parity_offset(episode)
    weight = pose_variance / (pose_variance + wrench_variance)
    settled = poses + weight * offset
    merged = (weight * wrench_variance).expand_as(poses)
    parity = parity_chi_square(episode, least_std)[:, None]
    # Either sensor may be at fault; a bad row is kept with a variance that covers both.
    bad = torch.where(parity > PARITY_LIMIT, offset**2, 0.0)
    return History(settled, merged + bad, commands, stiffness)


def parity_chi_square(episode: Episode, least_std: float = 2e-5) -> Float[Tensor, " n"]:
    """Chi-square (3 degrees of freedom) of w - K (x - u) for each row; see `history_of`."""
    variance = episode.sensor_std.double() ** 2 + least_std**2
    pose_variance, wrench_variance = variance[:3], variance[3:] / episode.stiffness.double() ** 2
    return (_parity_offset(episode) ** 2 / (pose_variance + wrench_variance)).sum(-1)


def _parity_offset(episode: Episode) -> Tensor:
    """Pose that the wrench tells minus the pose that was measured [m, m, rad]."""
    told = episode.wrenches.double() / episode.stiffness.double() + episode.commands.double()
    offset = told - episode.poses.double()
    return torch.cat((offset[:, :2], wrap_angle(offset[:, 2:])), dim=-1)
