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
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.simulator.record import ContactMode, StepSettings

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
MOST_SOUGHT = 16
"""Parts of a path that aim at a change of contact or are shortened; where it chatters, the rest is
taken as it is."""


def ends_alike(
    before: Int[Tensor, "b t"], now: Int[Tensor, "b t"], slid: Bool[Tensor, " b"]
) -> Bool[Tensor, " b"]:
    """Whether the end of a part, with the `ContactMode` of each terrain `before` it and `now` at
    its end, does not depend on where on the way contact changed.

    Where the same terrains are touched and no point has `slid`, modes are what the loads happen to
    be: between two terrains the law leaves them open.
    """
    loaded, loaded_before = (now > 0).sum(-1), (before > 0).sum(-1)
    slips = ((now > int(ContactMode.STICK)) & (before > 0)).any(-1)
    single = (loaded == 1) & ((loaded_before == 0) | ((loaded_before == 1) & slips))
    held = ((now > 0) == (before > 0)).all(-1) & ~slid
    return (now == before).all(-1) | (loaded == 0) | single | held


def parts_of_path(
    settings: StepSettings,
    turn: Float[Tensor, " b"],
    before: Int[Tensor, "b t"],
    now: Int[Tensor, "b t"],
    slid: Bool[Tensor, " b"],
) -> Int[Tensor, " b"]:
    """Into how many parts the path is cut, once it was gone as a whole; the command turns by
    `turn` [rad]."""
    if settings.substeps == 1:
        return torch.ones_like(now[:, 0])
    changes = ~ends_alike(before, now, slid) | settings.follow_path
    turns = (turn.abs() / settings.largest_turn - ALMOST).ceil()
    turns = torch.where((now > 0).any(-1) | (before > 0).any(-1), turns, 1.0).long()
    return torch.where(changes, settings.substeps, 1).maximum(turns)


def part_end(
    done: Float[Tensor, " b"], length: Float[Tensor, " b"], parts: Int[Tensor, " b"]
) -> Float[Tensor, " b"]:
    """Where the next part ends, as a share of the path."""
    share = torch.minimum(done + length, ((done * parts + ALMOST).floor() + 1) / parts)
    return torch.where(share < 1 - ALMOST, share, 1.0)


def least_part(kind: Int[Tensor, " b"], finest: float) -> Float[Tensor, " b"]:
    """Parts of a kind that are not shortened any more, as a share of the path."""
    found = torch.full(kind.shape, GLANCE, dtype=torch.float64, device=kind.device)
    return found.masked_fill(kind == TRY, finest).masked_fill(kind == LOOK, torch.inf)


def next_part(
    passes: Bool[Tensor, " b"],
    seeks: Bool[Tensor, " b"],
    ahead: Float[Tensor, " b"],
    left: Float[Tensor, " b"],
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"]]:
    """Kind and length of the part after one that was right.

    `passes` tells whether that one passed on to a change of contact, `seeks` whether changes are to
    be located, `ahead` where the next one is and `left` how far the path is straight.
    """
    aims = seeks & (SHY * ahead < left)
    kind = torch.where(passes, LOOK, torch.where(aims, AIM, TRY))
    length = torch.where(aims, (SHY * ahead).clamp_min(GLANCE), left)
    return kind, torch.where(passes, GLANCE, length)


def shorter_part(
    kind: Int[Tensor, " b"],
    moving: Bool[Tensor, " b"],
    ahead: Float[Tensor, " b"],
    gone: Float[Tensor, " b"],
    finest: float,
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"]]:
    """Kind and length of the part in place of one of length `gone` on which contact changed.

    An expected change is closed in on down to `GLANCE`, whatever `finest` is. `moving` tells
    whether contact is known for this direction, `ahead` where it changes next.
    """
    expected = (kind == TRY) & (SHY * ahead < gone)
    aims = (kind == AIM) | expected
    length = torch.where(expected, SHY * ahead, 0.5 * gone)
    length = length.maximum(torch.full_like(gone, finest).masked_fill(aims, GLANCE))
    after = torch.where(moving, torch.where(aims, AIM, TRY), LOOK)
    return after, torch.where(moving, length, GLANCE)
