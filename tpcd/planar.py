"""Planar rigid motions as batched tensors.

A pose is `(x, z, angle)` [m, m, rad] on the last axis, the angle counter-clockwise from
x towards z. Every function works on any leading batch axes and broadcasts.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def wrap_angle(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the angle wrapped to (-pi, pi] [rad]."""
    return math.pi - torch.remainder(math.pi - angle, 2 * math.pi)


def short_way(offsets: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Differences of poses (x, z, angle, whatever follows) [m, m, rad] with the angle in
    [-pi, pi)."""
    found = np.array(offsets)
    found[:, 2] = np.remainder(found[:, 2] + math.pi, 2 * math.pi) - math.pi
    return found


def spring_wrench(
    poses: Float[np.ndarray, "n 3"],
    commands: Float[np.ndarray, "n 3"],
    stiffness: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "n 3"]:
    """The wrench (F_x, F_z, tau) [N, N, N·m] that holds an impedance-controlled arm at rest at its
    pose, w = K (x - u), with the diagonal of K [N/m, N/m, N·m/rad]; the angle the short way."""
    return stiffness * short_way(poses - commands)


def rotate(
    angle: Float[Tensor, "*#batch"], vectors: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*batch2 2"]:
    """Rotate vectors counter-clockwise by an angle [rad].

    As a product of complex numbers x + iz, which takes a tenth of the time of four products.
    """
    turn = torch.polar(torch.ones_like(angle), angle)
    return torch.view_as_real(torch.view_as_complex(vectors.contiguous()) * turn)


def transform_points(
    pose: Float[Tensor, "*#batch 3"], points: Float[Tensor, "*#batch p 2"]
) -> Float[Tensor, "*batch2 p 2"]:
    """Map points from the frame that sits at `pose` into the frame `pose` is given in [m]."""
    return rotate(pose[..., None, 2], points) + pose[..., None, :2]


def compose(
    first: Float[Tensor, "*#batch 3"], second: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch2 3"]:
    """Pose of frame C in A, from B in A (`first`) and C in B (`second`)."""
    position = first[..., :2] + rotate(first[..., 2], second[..., :2])
    return torch.cat((position, wrap_angle(first[..., 2:] + second[..., 2:])), dim=-1)


def inverse(pose: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Pose of A in B, from the pose of B in A."""
    position = -rotate(-pose[..., 2], pose[..., :2])
    return torch.cat((position, wrap_angle(-pose[..., 2:])), dim=-1)


def perpendicular(vectors: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Rotate vectors by +90 degrees; also the derivative of a rotation by its angle."""
    return torch.stack((-vectors[..., 1], vectors[..., 0]), dim=-1)
