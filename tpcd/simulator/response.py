"""Linear response of a rest pose, by the implicit function theorem.

At rest the pose x' and the multipliers of the loaded contact rows solve

    K (x' - u) - B(x')^T lambda = 0,      c_j(x', start) = 0 for every loaded row j,            (2)

where B holds the force directions n + s mu t of the contacts as wrenches, and c_j is the gap alone
for a point that slips under Coulomb friction, or gap + s mu slip otherwise, and what the terrain
yields. The pose answers a change of their right-hand sides by

    dx = S (f + B^T dl),      (A S B^T + C) dl = r - A S f,      S = (K + turning)^-1,           (3)

A being the rows' derivatives by the pose, C the compliance of rows on one terrain, and `turning`
how the contact torques change as the outline turns.
"""

from __future__ import annotations

from typing import no_type_check

from tpcd.loops import inner
from tpcd.simulator.geometry import object_normal

SINGULAR = 1e-9
"""Determinant over the product of the row sums below which loaded rows count as dependent."""
DEPENDENT = 1e-12
"""Pivot over the largest row sum below which they do where terrains yield: little compliance makes
rows nearly dependent."""


@inner(error_model="numpy", forceinline=True)
@no_type_check
def linear_system(world, o, law, command, pose, turn, space):
    """Residuals and matrices of the rest equations (2) at `pose`.

    Fills `system`; False where the complement is singular.
    """
    system, chosen, multiplier = space.system, space.chosen, space.multiplier
    rows, pushes, starts = system.rows, system.pushes, system.starts
    turning = 0.0
    for a in range(3):
        system.unbalanced[a] = law.stiffness[a] * (pose[a] - command[a])
    for j in range(len(space.room)):
        system.violated[j] = 0.0
        for a in range(3):
            rows[j, a] = 0.0
            pushes[j, a] = 0.0
            starts[j, a] = 0.0
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
        system.violated[j] = gap + drag * slip + world.compliance[o, t] * space.load[t]
        rows[j, 0], rows[j, 1] = nx + drag * nz, nz - drag * nx
        rows[j, 2] = along - drag * height
        pushes[j, 0], pushes[j, 1] = nx + slope * nz, nz - slope * nx
        pushes[j, 2] = along - slope * height
        for a in range(3):
            system.unbalanced[a] -= multiplier[j] * pushes[j, a]
        turning += multiplier[j] * (height + slope * along)
        starts[j, 0], starts[j, 1] = -drag * nz, drag * nx
        starts[j, 2] = -drag * space.place[t, k, 3]
    system.soft[0], system.soft[1] = 1.0 / law.stiffness[0], 1.0 / law.stiffness[1]
    system.soft[2] = 1.0 / (law.stiffness[2] + turning)
    for j in range(len(space.room)):
        for k in range(len(space.room)):
            value = 1.0 if j == k else 0.0
            if chosen[j, 0] >= 0 and chosen[k, 0] >= 0:
                value = world.compliance[o, chosen[j, 1]] if chosen[j, 1] == chosen[k, 1] else 0.0
                for a in range(3):
                    value += rows[j, a] * system.soft[a] * pushes[k, a]
            system.inverse[j, k] = value
    if len(space.room) == 3:
        return _invert_3(system.inverse)
    return _invert(system.inverse, space.work)


@inner(error_model="numpy")
@no_type_check
def _invert_3(matrix):
    """Invert a 3 x 3 matrix in place; False, and zeros, where it is singular."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 0], matrix[1, 1], matrix[1, 2]
    g, h, k = matrix[2, 0], matrix[2, 1], matrix[2, 2]
    first, second, third = e * k - f * h, f * g - d * k, d * h - e * g
    determinant = a * first + b * second + c * third
    scale = (abs(a) + abs(b) + abs(c)) * (abs(d) + abs(e) + abs(f)) * (abs(g) + abs(h) + abs(k))
    if not abs(determinant) > SINGULAR * scale:
        for j in range(3):
            for i in range(3):
                matrix[j, i] = 0.0
        return False
    r = 1.0 / determinant
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = first * r, (c * h - b * k) * r, (b * f - c * e) * r
    matrix[1, 0], matrix[1, 1] = second * r, (a * k - c * g) * r
    matrix[1, 2], matrix[2, 0] = (c * d - a * f) * r, third * r
    matrix[2, 1], matrix[2, 2] = (b * g - a * h) * r, (a * e - b * d) * r
    return True


@inner(error_model="numpy")
@no_type_check
def _invert(matrix, other):
    """Invert a k x k matrix in place by elimination, with the first k rows of `other` as room for
    the inverse; False, and zeros, where it is singular."""
    k, largest = matrix.shape[0], 0.0
    for j in range(k):
        total = 0.0
        for i in range(k):
            total += abs(matrix[j, i])
            other[j, i] = 1.0 if j == i else 0.0
        largest = max(largest, total)
    regular = True
    for i in range(k):
        pivot = i
        for j in range(i + 1, k):
            if abs(matrix[j, i]) > abs(matrix[pivot, i]):
                pivot = j
        if not abs(matrix[pivot, i]) > DEPENDENT * largest:
            regular = False
            break
        for c in range(k):
            matrix[i, c], matrix[pivot, c] = matrix[pivot, c], matrix[i, c]
            other[i, c], other[pivot, c] = other[pivot, c], other[i, c]
        inverse = 1.0 / matrix[i, i]
        for c in range(k):
            matrix[i, c] *= inverse
            other[i, c] *= inverse
        for j in range(k):
            factor = matrix[j, i]
            if j == i or factor == 0.0:
                continue
            for c in range(k):
                matrix[j, c] -= factor * matrix[i, c]
                other[j, c] -= factor * other[i, c]
    for j in range(k):
        for i in range(k):
            matrix[j, i] = other[j, i] if regular else 0.0
    return regular


@inner
@no_type_check
def respond(space):
    """Pose change (3) for the right-hand sides `force` of the balance and `right` of the rows.

    Leaves it in `change`, and the change of the multipliers in `gain`; `system` must be filled.
    """
    system, chosen, force, gain = space.system, space.chosen, space.force, space.gain
    for j in range(len(space.room)):
        gain[j] = 0.0
    for j in range(len(space.room)):
        if chosen[j, 0] < 0:
            continue
        right = space.right[j]
        for a in range(3):
            right -= system.rows[j, a] * system.soft[a] * force[a]
        for i in range(len(space.room)):
            gain[i] += system.inverse[i, j] * right
    for a in range(3):
        # Rows of free places are zero.
        push = force[a]
        for j in range(len(space.room)):
            push += gain[j] * system.pushes[j, a]
        space.change[a] = system.soft[a] * push
