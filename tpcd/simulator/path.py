"""How the path of a command is cut into parts, since friction depends on the path.

One settling of a part answers for its end alone, which is right as long as contact is the same all
the way, and also where a single contact begins to slip or is lost: then the end does not depend on
where that happened. Where a contact that slipped comes to stick, it does, since it sticks to the
place where it stopped; and where floor and wall are touched, what one does depends on when the
other let go. Changes of contact on such a path are located. `LOOK` goes just far enough to see what
contact does in this direction, `AIM` goes nearly to where the first load or gap then comes to zero
at its rate (see `events`) and passes on to it, and `LOOK` sees what contact does beyond. Where none
is foreseen, `TRY` goes on as far as the path is straight. What no load foretells, as that a turning
object slips back, is closed in on by halving.

Contact modes are two bits for each terrain (see `ContactMode`).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from tpcd.loops import njit

TRY, LOOK, AIM = 0, 1, 2
"""Kinds of parts, as in the file's opening."""
GLANCE = 1 / 1024
"""Share of the path that `LOOK` goes."""
SHY = 0.995
"""Share of the way to an expected change of contact that is settled; the rest is passed at the rate
found there."""
PASSED = 0.02
"""Most that is passed so, as a share of what was settled. How the rate moves is left out of the
derivatives, whose error this keeps small."""
ALMOST = 1e-9
"""Share of a part that is no part of its own."""
LONGEST_WAY = 2e-3
"""Most that the command goes in one part where what is touched is curved [m]: an object does not
pass over what would hold it back."""
MOST_SOUGHT = 16
"""Parts of a path that aim at a change of contact or are shortened; where it chatters, the rest is
taken as it is."""


@njit(_nrt=False)
@no_type_check
def ends_alike(before, now, terrains, slid):
    """Whether the end of a part, with contact modes `before` it and `now` at its end, does not
    depend on where on the way contact changed.

    Where the same terrains are touched and no point has `slid`, modes are what the loads happen to
    be: between two terrains the law leaves them open.
    """
    if now == before or now == 0:
        return True
    loaded, loaded_before, slips, same = 0, 0, False, True
    for t in range(terrains):
        mode, mode_before = now >> 2 * t & 3, before >> 2 * t & 3
        loaded += mode > 0
        loaded_before += mode_before > 0
        slips = slips or mode > 1 and mode_before > 0
        same = same and (mode > 0) == (mode_before > 0)
    if same and not slid:
        return True
    return loaded == 1 and (loaded_before == 0 or loaded_before == 1 and slips)


@njit(_nrt=False)
@no_type_check
def parts_of_path(request, way, turn, before, now, terrains, slid, bends):
    """Into how many parts the path is cut, after it was gone at once; `bends` says that what was
    touched on the way is curved."""
    if request.substeps == 1:
        return 1
    parts = 1
    if request.follow_path or not ends_alike(before, now, terrains, slid):
        parts = request.substeps
    if bends:
        parts = max(parts, math.ceil(way / LONGEST_WAY - ALMOST))
    if now != 0 or before != 0:
        parts = max(parts, math.ceil(abs(turn) / request.largest_turn - ALMOST))
    return parts


@njit(_nrt=False)
@no_type_check
def part_end(done, length, parts):
    """Where the next part ends, as a share of the path."""
    share = min(done + length, (math.floor(done * parts + ALMOST) + 1.0) / parts)
    return share if share < 1.0 - ALMOST else 1.0


@njit(_nrt=False)
@no_type_check
def least_part(kind, finest):
    """Parts of a kind that are not shortened any more."""
    if kind == LOOK:
        return np.inf
    return finest if kind == TRY else GLANCE


@njit(_nrt=False)
@no_type_check
def next_part(passes, seeks, ahead, left):
    """Kind and length of the part after one that was right."""
    if passes:
        return LOOK, GLANCE
    if seeks and SHY * ahead < left:
        return AIM, max(SHY * ahead, GLANCE)
    return TRY, left


@njit(_nrt=False)
@no_type_check
def shorter_part(kind, moving, ahead, gone, finest):
    """Kind and length of the part in place of one of length `gone` on which contact changed."""
    if not moving:
        return LOOK, GLANCE
    if kind == TRY and SHY * ahead < gone:
        return AIM, max(SHY * ahead, GLANCE)
    if kind == AIM:
        return AIM, max(0.5 * gone, GLANCE)
    return TRY, max(0.5 * gone, finest)


@njit(_nrt=False)
@no_type_check
def sticking(mask, terrains):
    """Contact modes of an object that rests on the terrains of a bit mask."""
    modes = 0
    for t in range(terrains):
        modes |= (mask >> t & 1) << 2 * t
    return modes


@njit(_nrt=False, forceinline=True)
@no_type_check
def contact_modes(space, terrains):
    """Contact modes, two bits for each terrain, from the row that carries its largest load."""
    modes = 0
    for t in range(terrains):
        mode, largest = 0, 0.0
        for j in range(len(space.room)):
            load = space.multiplier[j]
            if space.chosen[j, 0] >= 0 and space.chosen[j, 1] == t and load > largest:
                largest = load
                slip = 2 if space.side[j] < 0.0 else 3
                mode = slip if space.slipping[j] else 1
        modes |= mode << 2 * t
    return modes
