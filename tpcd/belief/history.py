"""What has been measured so far, in the form the likelihood wants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.setting import Merged, Setting, merge
from tpcd.contact import ContactScene
from tpcd.data.episode import Episode
from tpcd.effects.conditions import (
    Conditions,
    Rows,
    bare_conditions,
    base_conditions,
    sequence,
)


@dataclass(frozen=True)
class History:
    """n transitions between n + 1 settled rows; poses and commands (x, z, angle) [m, m, rad].

    `readings` are measured pose and wrench, `sensor_variance` their noise; `merged` the poses
    estimated from both together without any effect.
    """

    commands: Float[Tensor, "rows 3"]
    readings: Float[Tensor, "rows 6"]
    sensor_variance: Float[Tensor, " 6"]
    stiffness: Float[Tensor, " 3"]
    merged: Merged
    used: Bool[Tensor, " n"]
    """Transitions that count; the others part the history into pieces."""
    seams: Bool[Tensor, " n"]
    """Where one recording ends and another begins; never in use."""
    parity_counts: bool = True
    """Whether what pose and wrench say about each other counts where effects can change it."""

    def __len__(self) -> int:
        """Number of transitions n."""
        return len(self.readings) - 1

    @property
    def poses(self) -> Float[Tensor, "rows 3"]:
        """Settled poses, estimated from pose and wrench together."""
        return self.merged.poses[0]

    @property
    def variance(self) -> Float[Tensor, "rows 3"]:
        """Variance of the poses."""
        return self.merged.variance[0]

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

    @property
    def read(self) -> Bool[Tensor, " rows"]:
        """Rows whose parity counts: those at an end of a transition that counts."""
        ends = torch.zeros(len(self.readings), dtype=torch.bool, device=self.used.device)
        if not self.parity_counts:
            return ends
        ends[1:] |= self.used
        ends[:-1] |= self.used
        return ends

    @property
    def rows(self) -> Rows:
        """The rows as effects see them; every recording is a run of its own."""
        follows = torch.arange(len(self.readings), device=self.seams.device)
        follows[1:] -= self.seams.logical_not().long()
        return sequence(self.readings[:, :3], follows)

    @property
    def bare(self) -> Conditions:
        """The conditions of the arm alone, without terrains or effects."""
        return bare_conditions(self.commands, self.stiffness)

    def setting(self, scene: ContactScene) -> Setting:
        """The history as it is without effects, for the scenes of m particles."""
        conditions = base_conditions(scene, self.commands, self.stiffness)
        return Setting(conditions, self.merged, self.used, self.settled[:, 2])

    def first(self, count: int) -> History:
        """The first transitions only."""
        last = count + 1
        return History(
            self.commands[:last],
            self.readings[:last],
            self.sensor_variance,
            self.stiffness,
            Merged(**{name: value[:, :last] for name, value in vars(self.merged).items()}),
            self.used[:count],
            self.seams[:count],
            self.parity_counts,
        )

    def using(self, used: Bool[Tensor, " n"]) -> History:
        """The same where only some of the transitions count."""
        return replace(self, used=used & ~self.seams)


def history_of(episode: Episode, least_std: float = 2e-5) -> History:
    """The transitions of an episode: row k explains how row k - 1 went over to it.

    `least_std` [m, m, rad] is added to the noise of poses, in quadrature: what the numerics
    of any simulator leave.
    """
    return joined_history([episode], least_std)


def joined_history(episodes: Sequence[Episode], least_std: float = 2e-5) -> History:
    """The transitions of some episodes of one set-up, one after the other.

    Raises ValueError where they differ in stiffness or noise.
    """
    first = episodes[0]
    for k, other in enumerate(episodes[1:], start=2):
        for name in ("stiffness", "sensor_std"):
            here, there = getattr(first, name).tolist(), getattr(other, name).tolist()
            if here != there:
                raise ValueError(
                    f"episode {k} has {name} {there}, the first one {here}; episodes of one run"
                    " must come from one set-up, so diagnose them apart"
                )
    commands = torch.cat([episode.commands for episode in episodes]).double()
    poses = torch.cat([episode.poses for episode in episodes])
    wrenches = torch.cat([episode.wrenches for episode in episodes])
    readings = torch.cat((poses, wrenches), dim=-1).double()
    variance = first.sensor_std.double() ** 2 + least_std**2
    stiffness = first.stiffness.double()
    seams = torch.zeros(len(readings) - 1, dtype=torch.bool)
    ends = torch.tensor([len(episode.poses) for episode in episodes]).cumsum(0)[:-1]
    seams[ends - 1] = True
    merged = merge(readings, variance, bare_conditions(commands, stiffness))
    return History(commands, readings, variance, stiffness, merged, ~seams, seams)
