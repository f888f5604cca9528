"""The contacts that carry load on a flat batch: picked out, overwritten, summed, and whether they
slip."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.implicit import loaded_frames
from tpcd.simulator.record import ContactSet

_FIELDS = ("multiplier", "point", "terrain", "side", "slipping")
SLIGHT = 10.0
"""Times the tolerance, up to which a point has not moved along a terrain."""


def terrain_load(contacts: ContactSet, terrains: int) -> Float[Tensor, "b t"]:
    """Normal force on each terrain [N]: every row of a contact pushes with its multiplier."""
    load = contacts.multiplier.new_zeros(len(contacts.multiplier), terrains)
    return load.scatter_add(1, contacts.terrain, contacts.multiplier)


def no_contacts(count: int, rows: int, like: Tensor) -> ContactSet:
    """Of so many elements that nothing touches, with room for so many rows, and with the dtype and
    device of a tensor."""
    zeros = like.new_zeros(count, rows)
    index = torch.zeros(count, rows, dtype=torch.long, device=like.device)
    return ContactSet(zeros, index, index.clone(), zeros.clone(), index.bool())


def take_contacts(contacts: ContactSet, index: Int[Tensor, " i"]) -> ContactSet:
    """Those of some elements."""
    return ContactSet(*(getattr(contacts, name)[index] for name in _FIELDS))


def put_contacts(contacts: ContactSet, index: Int[Tensor, " i"], values: ContactSet) -> None:
    """Overwrite those of some elements, in place."""
    for name in _FIELDS:
        getattr(contacts, name)[index] = getattr(values, name)


def with_slip(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    tolerance: float,
) -> ContactSet:
    """Mark the loaded rows whose point slips.

    One held by both its sides has not slipped. Where all of a terrain's load is at one edge of
    the friction cone, slip begins, however little it still is.
    """
    slip = _slip(scene, start, pose, contacts)
    loaded = contacts.multiplier > 0
    beside = (contacts.terrain[:, :, None] == contacts.terrain[:, None, :]) & (
        loaded[:, :, None] & loaded[:, None, :]
    )
    held = (beside & (contacts.point[:, :, None] == contacts.point[:, None, :])).sum(-1) > 1
    other_side = contacts.side[:, :, None] != contacts.side[:, None, :]
    one_sided = ~(beside & other_side).any(-1)
    slips = one_sided | (slip.abs() > SLIGHT * tolerance)
    return replace(contacts, slipping=loaded & ~held & slips)


def slide(
    scene: ContactScene,
    start: Float[Tensor, "b 3"],
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    tolerance: float,
) -> Bool[Tensor, " b"]:
    """Whether a loaded point has moved along its terrain since the start."""
    slip = _slip(scene, start, pose, contacts).abs()
    return ((contacts.multiplier > 0) & (slip > SLIGHT * tolerance)).any(-1)


def _slip(scene: ContactScene, start: Tensor, pose: Tensor, contacts: ContactSet) -> Tensor:
    now, before = (loaded_frames(scene, at, contacts) for at in (pose, start))
    return ((now.points_world - before.points_world) * now.tangent).sum(-1)
