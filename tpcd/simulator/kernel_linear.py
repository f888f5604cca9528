"""Linear response of a rest pose in compiled loops, as in `implicit`: the rest equations of the
rows that carry load, and how the pose answers a change of their right-hand sides.
"""

from __future__ import annotations

from typing import no_type_check

from tpcd.simulator.implicit import SINGULAR
from tpcd.simulator.kernel_geometry import object_normal
from tpcd.simulator.kernel_inner import inner


@inner(error_model="numpy", forceinline=True)
@no_type_check
def linear_system(world, o, law, command, pose, turn, space):
    """Residuals and matrices of the rest equations at `pose`, as in `implicit`.

    Fills `system`: constraint rows 0-2, force rows 3-5, inverse stiffness 6, force residual
    7, row residual 8, inverse of the Schur complement 9-11, start rows 12-14. False where
    the complement is singular.
    """
    system, chosen, multiplier = space.system, space.chosen, space.multiplier
    turning = 0.0
    for a in range(3):
        system[7, a] = law.stiffness[a] * (pose[a] - command[a])
    for j in range(3):
        system[8, j] = 0.0
        for a in range(3):
            system[j, a] = 0.0
            system[3 + j, a] = 0.0
            system[12 + j, a] = 0.0
        if chosen[j, 0] < 0:
            continue
        t, k = chosen[j, 1], chosen[j, 2]
        nx, nz = world.normals[o, t, 0], world.normals[o, t, 1]
        u, v = object_normal(world, o, t, turn[0], turn[1])
        x, z = space.place[t, k, 0], space.place[t, k, 1]
        height, along = u * x + v * z, v * x - u * z
        slope = space.side[j] * world.friction[o, t]
        drag = 0.0 if (law.coulomb and space.slipping[j]) else slope
        slip = along + nz * pose[0] - nx * pose[1] - space.place[t, k, 2]
        gap = height + nx * pose[0] + nz * pose[1] - world.offsets[o, t]
        system[8, j] = gap + drag * slip + law.compliance * space.load[t]
        system[j, 0], system[j, 1] = nx + drag * nz, nz - drag * nx
        system[j, 2] = along - drag * height
        system[3 + j, 0], system[3 + j, 1] = nx + slope * nz, nz - slope * nx
        system[3 + j, 2] = along - slope * height
        for a in range(3):
            system[7, a] -= multiplier[j] * system[3 + j, a]
        turning += multiplier[j] * (height + slope * along)
        system[12 + j, 0], system[12 + j, 1] = -drag * nz, drag * nx
        system[12 + j, 2] = -drag * space.place[t, k, 3]
    system[6, 0], system[6, 1] = 1.0 / law.stiffness[0], 1.0 / law.stiffness[1]
    system[6, 2] = 1.0 / (law.stiffness[2] + turning)
    for j in range(3):
        for k in range(3):
            value = 1.0 if j == k else 0.0
            if chosen[j, 0] >= 0 and chosen[k, 0] >= 0:
                value = law.compliance if chosen[j, 1] == chosen[k, 1] else 0.0
                for a in range(3):
                    value += system[j, a] * system[6, a] * system[3 + k, a]
            system[9 + j, k] = value
    return _invert(system)


@inner(error_model="numpy")
@no_type_check
def _invert(system):
    """Invert the 3 x 3 matrix in rows 9-11 in place; False, and zeros, where it is singular."""
    a, b, c = system[9, 0], system[9, 1], system[9, 2]
    d, e, f = system[10, 0], system[10, 1], system[10, 2]
    g, h, k = system[11, 0], system[11, 1], system[11, 2]
    first, second, third = e * k - f * h, f * g - d * k, d * h - e * g
    determinant = a * first + b * second + c * third
    scale = (abs(a) + abs(b) + abs(c)) * (abs(d) + abs(e) + abs(f)) * (abs(g) + abs(h) + abs(k))
    if not abs(determinant) > SINGULAR * scale:
        for j in range(3):
            for i in range(3):
                system[9 + j, i] = 0.0
        return False
    r = 1.0 / determinant
    system[9, 0], system[9, 1], system[9, 2] = first * r, (c * h - b * k) * r, (b * f - c * e) * r
    system[10, 0], system[10, 1] = second * r, (a * k - c * g) * r
    system[10, 2], system[11, 0] = (c * d - a * f) * r, third * r
    system[11, 1], system[11, 2] = (b * g - a * h) * r, (a * e - b * d) * r
    return True


@inner
@no_type_check
def respond(space):
    """Pose change for the right-hand sides `force` of the balance and `right` of the rows.

    Leaves it in `change`, and the change of the multipliers in `gain`; `system` must be filled.
    """
    system, chosen, force = space.system, space.chosen, space.force
    m0 = m1 = m2 = 0.0
    for j in range(3):
        if chosen[j, 0] < 0:
            continue
        right = space.right[j]
        for a in range(3):
            right -= system[j, a] * system[6, a] * force[a]
        m0 += system[9, j] * right
        m1 += system[10, j] * right
        m2 += system[11, j] * right
    space.gain[0], space.gain[1], space.gain[2] = m0, m1, m2
    for a in range(3):
        # Rows of free places are zero.
        push = force[a] + m0 * system[3, a] + m1 * system[4, a] + m2 * system[5, a]
        space.change[a] = system[6, a] * push
