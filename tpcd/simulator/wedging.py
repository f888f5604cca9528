"""Rest poses between two rough terrains: what can slip is not held by a wedge.

Coulomb's law may allow both that an object in a corner slips and that it is held there, by forces
between the terrains that nothing has pressed it with (on straight terrains at right angles with
mu >= 1, and with less where the outline turns about its contacts). The fixed point of `rest`
starts without slip and may end in such a wedge, or creep into one. It is therefore sought from the
other end too, the pose without friction, and that with less load is taken. So are answers for what
is jammed, or did not converge, between two terrains. On steps in corners that is what MuJoCo does
when the arm moves slowly, and what terrains that yield by some micrometres do.

Most rest in one way whatever is asked of them, and are spared the search. Each of the two contacts
is free, sticks, or slips either way, and in each of these cases loads and motion are linear in the
command. They follow from it in one way if the determinants of all cases have the same sign (for
problems of complementarity these are the P-matrices of Samelson, Thrall and Wesler, "A partition
theorem for Euclidean n-space", 1958; for friction see Klarbring, "Examples of non-uniqueness and
non-existence of solutions to quasistatic contact problems with friction", 1990). Without friction
they are positive. They stay so while what friction adds is less than what was there.
"""

from __future__ import annotations

from typing import no_type_check

from tpcd.loops import inner
from tpcd.simulator.rest import CONVERGED

LIGHTER = 0.999
"""Share of the load below which an answer has less."""
SINGLE = 0.95
"""Share of what was there that friction may add where an object surely rests in one way: contacts
are not quite where they would be elsewhere. Of steps in corners that had another answer with less
load, none had less than 1."""


@inner(forceinline=True)
@no_type_check
def may_wedge(world, o, law, space, ended):
    """Whether two terrains load the element, settled with the status `ended`, such that it may
    rest elsewhere too."""
    chosen, first, second, alone = space.chosen, -1, -1, True
    for j in range(len(space.room)):
        if chosen[j, 0] < 0:
            continue
        if first < 0:
            first = j
        elif chosen[j, 1] == chosen[first, 1]:
            alone = alone and chosen[j, 0] == chosen[first, 0]
        elif second < 0:
            second = j
        else:
            same = chosen[j, 1] == chosen[second, 1] and chosen[j, 0] == chosen[second, 0]
            alone = alone and same
    if second < 0 or not law.coulomb:
        return False
    alone = alone and ended == CONVERGED
    return not (alone and _rests_one_way(world, o, law, space, first, second))


@inner(error_model="numpy")
@no_type_check
def _rests_one_way(world, o, law, space, first, second):
    """Whether loads and slips of two contact points follow from any command in one way."""
    a, b = _rows(space, first), _rows(space, second)
    t, s = space.chosen[first, 1], space.chosen[second, 1]
    rough_a, rough_b = world.friction[o, t], world.friction[o, s]
    give_a = _product(law, a[0], a[0]) + world.compliance[o, t]
    give_b = _product(law, b[0], b[0]) + world.compliance[o, s]
    drag_a, drag_b = _product(law, a[0], a[1]), _product(law, b[0], b[1])
    if not rough_a * abs(drag_a) < SINGLE * give_a or not rough_b * abs(drag_b) < SINGLE * give_b:
        return False
    both, by_a, by_b = (
        _product(law, a[0], b[0]),
        _product(law, b[0], a[1]),
        _product(law, a[0], b[1]),
    )
    for i in range(4):
        slip_a, slip_b = rough_a * (1.0 - 2.0 * (i % 2)), rough_b * (1.0 - 2.0 * (i // 2))
        crossed = (both + slip_a * by_a) * (both + slip_b * by_b)
        if not crossed < SINGLE * (give_a + slip_a * drag_a) * (give_b + slip_b * drag_b):
            return False
    along_a, along_b = _product(law, a[1], a[1]), _product(law, b[1], b[1])
    across = _product(law, a[1], b[1])
    return _slips_one_way(
        rough_b, give_a, drag_a, along_a, give_b, drag_b, both, by_a, by_b, across
    ) and _slips_one_way(rough_a, give_b, drag_b, along_b, give_a, drag_a, both, by_b, by_a, across)


@inner(error_model="numpy")
@no_type_check
def _slips_one_way(rough, give_i, drag_i, along_i, give, drag, both, by_i, by, across):
    """Whether a contact slips in one way while the other one, i, sticks: its own numbers without
    what it shares with normal and tangent of i."""
    size = give_i * along_i - drag_i * drag_i
    normal = (along_i * both - drag_i * by_i) / size
    tangent = (give_i * by_i - drag_i * both) / size
    left = give - both * normal - by_i * tangent
    return rough * abs(drag - by * normal - across * tangent) < SINGLE * left


@inner
@no_type_check
def _rows(space, j):
    """How gap and place of a loaded row's point move with the pose."""
    t, k = space.chosen[j, 1], space.chosen[j, 2]
    nx, nz = space.record[t, k, 1], space.record[t, k, 2]
    return (nx, nz, space.record[t, k, 4]), (nz, -nx, -space.record[t, k, 3])


@inner(error_model="numpy", forceinline=True)
@no_type_check
def _product(law, one, other):
    """Of two rows, as the arm's spring yields to them."""
    return (
        one[0] * other[0] / law.stiffness[0]
        + one[1] * other[1] / law.stiffness[1]
        + one[2] * other[2] / law.stiffness[2]
    )
