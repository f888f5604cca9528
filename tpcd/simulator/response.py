"""Linear response of a rest pose, by the implicit function theorem.

At rest the pose x' and the multipliers of the loaded contact rows solve

    K (x' - u) - B(x')^T lambda = 0,      c_j(x', start) = 0 for every loaded row j,            (2)

where B holds the force directions n + s mu t of the contacts as wrenches, and c_j is the gap alone
for a point that slips under Coulomb friction, or gap + s mu slip otherwise, and what the terrain
yields. The pose answers a change of their right-hand sides by

    dx = S (f + B^T dl),      (A S B^T + C) dl = r - A S f,      S = (K + turning)^-1,           (3)

A being the rows' derivatives by the pose, C the compliance of rows on one terrain, and `turning`
how the contact forces change as the outline turns and moves along what is curved: with normal row
n, tangent row t, height h, lever l, curvature k and s = +-mu the sum over contacts of

    lambda [(h + s l) e_phi e_phi^T - k (t - s n) t^T].
"""

from __future__ import annotations

from typing import no_type_check

from tpcd.geometry.query import bent
from tpcd.loops import inner

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
    soft, left, push = system.soft, system.left, system.push
    curved = bent(world.surfaces)
    for a in range(3):
        system.unbalanced[a] = law.stiffness[a] * (pose[a] - command[a])
        for b in range(3):
            soft[a, b] = law.stiffness[a] if a == b else 0.0
    for j in range(len(space.room)):
        system.violated[j] = 0.0
        for a in range(3):
            rows[j, a] = 0.0
            pushes[j, a] = 0.0
            starts[j, a] = 0.0
        if chosen[j, 0] < 0:
            continue
        t, k = chosen[j, 1], chosen[j, 2]
        place, record = space.place, space.record
        gap, nx, nz = record[t, k, 0], record[t, k, 1], record[t, k, 2]
        height, along = record[t, k, 3], record[t, k, 4]
        ax = turn[0] * place[t, k, 0] - turn[1] * place[t, k, 1]
        az = turn[1] * place[t, k, 0] + turn[0] * place[t, k, 1]
        # How far the point has come since the part's start.
        dx, dz = pose[0] + ax - place[t, k, 4], pose[1] + az - place[t, k, 5]
        slope = space.side[j] * world.friction[o, t]
        drag = 0.0 if (law.coulomb and space.slipping[j]) else slope
        slip = nz * dx - nx * dz
        system.violated[j] = gap + drag * slip + world.compliance[o, t] * space.load[t]
        pushes[j, 0], pushes[j, 1] = nx + slope * nz, nz - slope * nx
        pushes[j, 2] = along - slope * height
        for a in range(3):
            system.unbalanced[a] -= multiplier[j] * pushes[j, a]
        soft[2, 2] += multiplier[j] * (height + slope * along)
        starts[j, 0], starts[j, 1] = -drag * nz, drag * nx
        starts[j, 2] = drag * (nx * place[t, k, 2] + nz * place[t, k, 3])
        if curved:
            bend = record[t, k, 5]
            tangent = (nz, -nx, -height)
            bent_push = (nz - slope * nx, -nx - slope * nz, -height - slope * along)
            for a in range(3):
                for b in range(3):
                    soft[a, b] -= multiplier[j] * bend * bent_push[a] * tangent[b]
            drag *= 1.0 - bend * (nx * dx + nz * dz)
        rows[j, 0], rows[j, 1] = nx + drag * nz, nz - drag * nx
        rows[j, 2] = along - drag * height
    if curved:
        _invert_3(soft)
        for j in range(len(space.room)):
            for a in range(3):
                left[j, a], push[j, a] = 0.0, 0.0
                for b in range(3):
                    left[j, a] += rows[j, b] * soft[b, a]
                    push[j, a] += soft[a, b] * pushes[j, b]
    else:
        for a in range(3):
            soft[a, a] = 1.0 / soft[a, a]
        for j in range(len(space.room)):
            for a in range(3):
                left[j, a] = rows[j, a] * soft[a, a]
                push[j, a] = soft[a, a] * pushes[j, a]
    for j in range(len(space.room)):
        for k in range(len(space.room)):
            value = 1.0 if j == k else 0.0
            if chosen[j, 0] >= 0 and chosen[k, 0] >= 0:
                value = world.compliance[o, chosen[j, 1]] if chosen[j, 1] == chosen[k, 1] else 0.0
                for a in range(3):
                    value += rows[j, a] * push[k, a]
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
            right -= system.left[j, a] * force[a]
        for i in range(len(space.room)):
            gain[i] += system.inverse[i, j] * right
    for a in range(3):
        # Rows of free places are zero.
        value = 0.0
        for b in range(3):
            value += system.soft[a, b] * force[b]
        for j in range(len(space.room)):
            value += gain[j] * system.push[j, a]
        space.change[a] = value
