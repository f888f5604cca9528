"""From which side contact forces act: the one thing at rest that shows a mirrored angle and torque.

An angle that is measured backwards together with its torque leaves w = K (x - u) as it is. But a
force that acts at r from the hand makes the torque r_x F_z - r_z F_x, so rows that are pressed in
one direction with varying friction tell r along the force; and a world that can only push acts on
the far side of what it pushes, F · r < 0. Mirrored, it would act from within.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

LEAST_FORCE = 1.0
"""Rows pressed harder than this [N] count."""
LEAST_ROWS = 5
"""Pressed in one direction, for three unknowns."""


def depth_of_contact(
    wrenches: Float[np.ndarray, "k 3"], angles: Float[np.ndarray, " k"], noise: float
) -> tuple[float, float]:
    """How far before the hand, against the force, contact forces act [m], and its standard error;
    (0, inf) where nothing shows it.

    For the rows pressed most along each of +x, -x, +z and -z, least squares of
    tau = (r_x + c phi) F_z - r_z F_x (or the same for x), where c phi is the contact's rolling;
    `noise` is that of tau [N·m]. The four are averaged by their precision.
    """
    depths, weights = [], []
    for along, across, turn in ((0, 1, -1.0), (1, 0, 1.0)):
        for sign in (1.0, -1.0):
            force, friction = wrenches[:, along], wrenches[:, across]
            rows = (sign * force > np.abs(friction)) & (sign * force > LEAST_FORCE)
            if rows.sum() < LEAST_ROWS:
                continue
            force, friction = force[rows], friction[rows]
            design = np.column_stack((-turn * friction, turn * force, angles[rows] * force))
            found, _, rank, _ = np.linalg.lstsq(design, wrenches[rows, 2], rcond=1e-9)
            if rank < 3:
                continue
            left = wrenches[rows, 2] - design @ found
            variance = max(float(left @ left) / max(int(rows.sum()) - 3, 1), noise**2)
            error = variance * float(np.linalg.inv(design.T @ design)[0, 0])
            depths.append(-sign * float(found[0]))
            weights.append(1.0 / max(error, 1e-12))
    if not depths:
        return 0.0, float("inf")
    return float(np.average(depths, weights=weights)), float(sum(weights) ** -0.5)
