"""How the path of a command is cut into parts, since friction depends on the path.

One settling of a part answers for its end alone, which is right as long as contact is the same all
the way, and also where a single contact begins to slip or is lost: then the end does not depend on
where that happened. Where a contact that slipped comes to stick, it does, since it sticks to the
place where it stopped; and where floor and wall are touched, what one does depends on when the
other let go. Such parts are halved, down to a shortest one.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.simulator.record import ContactMode, StepSettings

ALMOST = 1e-9
"""Share of a part that is no part of its own."""
MOST_LOCATED = 6
"""Changes of contact that are located on one path; where it chatters, later ones are not."""


def ends_alike(before: Int[Tensor, "b t"], now: Int[Tensor, "b t"]) -> Bool[Tensor, " b"]:
    """Whether the end of a part, with the `ContactMode` of each terrain `before` it and `now` at
    its end, does not depend on where on the way contact changed."""
    loaded, loaded_before = (now > 0).sum(-1), (before > 0).sum(-1)
    slips = ((now > int(ContactMode.STICK)) & (before > 0)).any(-1)
    single = (loaded == 1) & ((loaded_before == 0) | ((loaded_before == 1) & slips))
    return (now == before).all(-1) | (loaded == 0) | single


def parts_of_path(
    settings: StepSettings,
    turn: Float[Tensor, " b"],
    before: Int[Tensor, "b t"],
    now: Int[Tensor, "b t"],
) -> Int[Tensor, " b"]:
    """Into how many parts the path is cut, once it was gone as a whole; the command turns by
    `turn` [rad]."""
    if settings.substeps == 1:
        return torch.ones_like(now[:, 0])
    changes = ~ends_alike(before, now) | settings.follow_path
    turns = (turn.abs() / settings.largest_turn - ALMOST).ceil()
    turns = torch.where((now > 0).any(-1) | (before > 0).any(-1), turns, 1.0).long()
    return torch.where(changes, settings.substeps, 1).maximum(turns)


def part_end(
    done: Float[Tensor, " b"], length: Float[Tensor, " b"], parts: Int[Tensor, " b"]
) -> Float[Tensor, " b"]:
    """Where the next part ends, as a share of the path."""
    share = torch.minimum(done + length, ((done * parts + ALMOST).floor() + 1) / parts)
    return torch.where(share < 1 - ALMOST, share, 1.0)
