"""What the arm is asked, what it meets and how it is read, row by row: where effects act.

A row is a command and what is measured once the arm has settled after it; a transition goes
over to a row from the one before. The base model fills `Conditions` from theta, and effects
change them. Fields have the axes (m, r, ...) of particles and rows, of which each may be 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from tpcd.contact import ContactScene
from tpcd.planar import wrap_angle
from tpcd.terrain import HalfPlane, floor, wall

FLOOR, WALL = 0, 1
"""Positions of the terrains."""
MOST_BACK = 0.8
"""Share of a row's last move that the next look at it may go back."""


@dataclass(frozen=True)
class Rows:
    """What is known of r rows before anything is simulated."""

    follows: Int[Tensor, " r"]
    """The row that each one comes after; a first row comes after itself."""
    share: Float[Tensor, " r"]
    """How much of the run has passed, from 0 to 1."""
    starts: Float[Tensor, "*#m r 3"]
    """Pose at the start of each row's transition, the end of the row it follows [m, m, rad]:
    the one that was measured, or in rollouts each particle's own."""

    def before(self, value: Float[Tensor, "m s *rest"]) -> Float[Tensor, "m s *rest"]:
        """The value at the row that each row follows."""
        return value if value.shape[1] == 1 else value[:, self.follows]


@dataclass(frozen=True)
class Outcome:
    """How the rows settle under the conditions of the pass before."""

    pose: Float[Tensor, "m r 3"]
    """Settled pose [m, m, rad]; where a row follows no other, its start."""
    mode: Int[Tensor, "m r t"]
    """`ContactMode` against each terrain."""
    load: Float[Tensor, "m r t"]
    """Normal force of each terrain [N]."""
    drag: Float[Tensor, "m r t"]
    """Tangential force of each terrain on the object, along the terrain's tangent [N]."""
    arm: Float[Tensor, "m r t 2"]
    """From the end effector to the contact point, in world axes [m]."""
    first: Bool[Tensor, "m r"]
    """Whether effects had no outcome to answer to when the row settled so."""
    outline: Float[Tensor, "m p 2"]
    """Points of the object in the end-effector frame [m], with no turn in the hand."""
    view: Float[Tensor, "m r 3"]
    """Pose from which effects should look at terrains that are bent [m, m, rad]: near to the
    settled one, but not so that what is seen from there makes the next one fall back."""
    missed: Float[Tensor, "m r"]
    """How far along x the row settled from where it was looked at from [m]; NaN if from nowhere."""

    @classmethod
    def of(
        cls,
        pose: Float[Tensor, "m r 3"],
        mode: Int[Tensor, "m r t"],
        contacts: Float[Tensor, "m r t 4"],
        outline: Float[Tensor, "m p 2"],
        first: bool = False,
    ) -> Outcome:
        """From how rows settle, with `contacts` as in `Transition`."""
        load, drag, arm = contacts[..., 0], contacts[..., 1], contacts[..., 2:]
        missed = torch.full_like(pose[..., 0], torch.nan)
        return cls(pose, mode, load, drag, arm, missed.isnan() & first, outline, pose, missed)

    def between(self, before: Outcome) -> Outcome:
        """The same, to be looked at from half the way that the rows have come since `before`."""
        return replace(self, view=before.pose + 0.5 * angle_difference(self.pose, before.pose))

    def after(self, before: Outcome | None) -> Outcome:
        """The same, to be looked at from where rows that are looked at from there should settle.

        Where the floor is bent so much that looking from where a row settles would make it jump to
        and fro, that is by the secant of the last two misses (Anderson 1965, of depth one).
        """
        if before is None:
            return self
        missed = self.pose[..., 0] - before.view[..., 0]
        share = (missed / (missed - before.missed)).nan_to_num(0.0, 0.0, 0.0).clamp(0.0, MOST_BACK)
        back = share[..., None] * angle_difference(before.pose, self.pose)
        return replace(self, view=self.pose + back, missed=missed)

    @property
    def place(self) -> Float[Tensor, "m r t 2"]:
        """Contact point in the world [m]."""
        return self.pose[:, :, None, :2] + self.arm

    def __getitem__(self, index: Tensor | slice) -> Outcome:
        """Of some particles."""
        return Outcome(**{name: value[index] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Conditions:
    """Everything that effects can change; world axes, SI units."""

    command: Float[Tensor, "#m #r 3"]
    """Pose that the controller pursues [m, m, rad]."""
    stiffness: Float[Tensor, "#m #r 3"]
    """Diagonal of the controller's true stiffness [N/m, N/m, N·m/rad]."""
    load: Float[Tensor, "#m #r 3"]
    """Wrench on the arm that is not of contact but is measured [N, N, N·m]."""
    pull: Float[Tensor, "#m #r 3"]
    """Wrench on the object at its contacts besides their normal forces and friction."""
    turn: Float[Tensor, "#m #r 1"]
    """Angle of the object in the hand besides its mount [rad]."""
    normal: Float[Tensor, "#m #r t 2"]
    """Outward unit normals of the terrains."""
    offset: Float[Tensor, "#m #r t"]
    """Planes n·p = offset [m]."""
    friction: Float[Tensor, "#m #r t"]
    """Coulomb coefficients."""
    compliance: Float[Tensor, "#m #r t"]
    """How far each terrain yields along its normal under a load, at least 0 [m/N]."""
    give: Float[Tensor, "#m #r 3"]
    """How far floor and wall are displaced on the way to the row, with what they hold [m, m, rad];
    planes are not turned by its angle, which should stay 0."""
    sensor: Float[Tensor, "#m #r 3 3"]
    """Matrix by which the true wrench is read."""
    bias: Float[Tensor, "#m #r 3"]
    """Added to the wrench that is read [N, N, N·m]."""
    warp: Float[Tensor, "#m #r #p 2"]
    """What outline points are moved by, in the end-effector frame [m]: where a terrain is bent, the
    points are as high over its plane as the true ones are over the terrain."""

    @property
    def target(self) -> Float[Tensor, "#m #r 3"]:
        """Command at which the arm, without other loads, feels the same contact."""
        return self.command + (self.load + self.pull) / self.stiffness

    @property
    def turned(self) -> Float[Tensor, "#m #r 3"]:
        """`turn` as a change of pose [m, m, rad]."""
        return pad(self.turn, (2, 0))

    def stiffness_along(self, direction: Float[Tensor, "m r 2"]) -> Float[Tensor, "m r"]:
        """Of the arm, along unit vectors [N/m]."""
        return (direction**2 * self.stiffness[..., :2]).sum(-1)

    @property
    def carried(self) -> Float[Tensor, "#m #r 3"]:
        """`give`, zero where it is no number. A step is solved as seen from the ground: target and
        planes are moved back by it, and the settled pose forward."""
        return self.give.nan_to_num(0.0)

    @property
    def offset_seen(self) -> Float[Tensor, "#m #r t"]:
        """Offsets of the planes as seen from ground that is carried [m]."""
        return self.offset - (self.normal * self.carried[:, :, None, :2]).sum(-1)

    @property
    def warps(self) -> bool:
        """Whether any point of an outline may be moved."""
        return self.warp.shape[2] > 1

    def scene(self, points_ee: Float[Tensor, "m 1 p 2"]) -> ContactScene:
        """Outlines and planes as a scene of batch (m, r), or (m, 1) where rows are alike."""
        offset = self.offset_seen
        each = torch.broadcast_shapes(
            self.normal.shape[:3],
            offset.shape,
            self.friction.shape,
            self.compliance.shape,
            (len(points_ee), self.warp.shape[1], 1),
        )
        normals, offsets = self.normal.expand(*each, 2), offset.expand(each)
        planes = zip(normals.unbind(2), offsets.unbind(2), strict=True)
        return ContactScene(
            points_ee + self.warp if self.warps else points_ee,
            tuple(HalfPlane(*plane) for plane in planes),
            self.friction.expand(each),
            self.compliance.expand(each),
        )


def base_conditions(
    scene: ContactScene, commands: Float[Tensor, "r 3"], stiffness: Float[Tensor, " 3"]
) -> Conditions:
    """The conditions without any effect; the scene has the batch axis of m particles."""
    planes = [body for body in scene.terrains if isinstance(body, HalfPlane)]
    return replace(
        bare_conditions(commands, stiffness),
        normal=torch.stack([p.direction for p in planes], -2)[:, None],
        offset=torch.stack([p.offset for p in planes], -1)[:, None],
        friction=scene.friction[:, None],
        compliance=scene.compliance[:, None],
    )


def bare_conditions(commands: Float[Tensor, "r 3"], stiffness: Float[Tensor, " 3"]) -> Conditions:
    """The conditions of an arm whose terrains are unknown, put at the origin."""
    zero = commands.new_zeros(1, 1, 3)
    terrains = (floor(zero[..., 0]), wall(zero[..., 0]))
    return Conditions(
        command=commands[None],
        stiffness=stiffness[None, None],
        load=zero,
        pull=zero,
        turn=zero[..., :1],
        normal=torch.stack([plane.direction for plane in terrains], -2),
        offset=zero[..., :2],
        friction=zero[..., :2],
        compliance=zero[..., :2],
        give=zero,
        sensor=torch.eye(3, dtype=commands.dtype)[None, None],
        bias=zero,
        warp=zero[..., None, :2],
    )


def sequence(poses: Float[Tensor, "r 3"], follows: Int[Tensor, " r"] | None = None) -> Rows:
    """Rows one after the other, as in an episode; a run begins where a row follows itself."""
    count = len(poses)
    if follows is None:
        follows = (torch.arange(count) - 1).clamp_min(0)
    place = torch.arange(count)
    begins = torch.where(follows == place, place, 0).cummax(0).values
    sizes = begins.bincount(minlength=count)[begins]
    share = (place - begins) / (sizes - 1).clamp_min(1)
    return Rows(follows, share.double(), poses[follows])


def angle_difference(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """Pose a minus pose b, the angle the short way round."""
    offset = a - b
    return torch.cat((offset[..., :2], wrap_angle(offset[..., 2:])), dim=-1)
