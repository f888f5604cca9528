"""What effects may hand back, since anyone can write one: well-formed conditions, row by row.

An effect that is malformed stops with its name. One that merely has no answer for a particle
(a logarithm of what is negative, a stiffness below zero) makes that particle settle at NaN,
so that it gets no weight; its other conditions stay as they were before the effect, and
nothing that is solved for all particles together ever meets the NaN.
"""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from tpcd.effects.conditions import Conditions, Outcome, Rows

FIELDS = tuple(field.name for field in fields(Conditions))
_LEAST_DETERMINANT = 1e-9


def malformed(before: Conditions, after: object, particles: int, rows: int, points: int) -> str:
    """What is wrong with the form of conditions that an effect returned, for outlines of so many
    points; empty if nothing is."""
    if not isinstance(after, Conditions):
        return f"returns {type(after).__name__}, expected the conditions"
    for name in changed(before, after):
        old, value = getattr(before, name), getattr(after, name)
        if not isinstance(value, Tensor) or value.dtype != old.dtype:
            found = value.dtype if isinstance(value, Tensor) else type(value).__name__
            return f"returns {name} as {found}, expected {old.dtype}"
        rest = (points, 2) if name == "warp" else tuple(old.shape[2:])
        lead = value.ndim == old.ndim and value.shape[0] in (1, particles)
        if not lead or value.shape[1] not in (1, rows) or tuple(value.shape[2:]) != rest:
            ending = "".join(f", {size}" for size in rest)
            return (
                f"returns {name} of shape {tuple(value.shape)}, expected"
                f" (1 or {particles}, 1 or {rows}{ending}) for particles and rows"
            )
    return ""


def changed(before: Conditions, after: Conditions) -> list[str]:
    """Names of the fields that are not the very same tensors."""
    return [name for name in FIELDS if getattr(after, name) is not getattr(before, name)]


def unusable(before: Conditions, after: Conditions) -> dict[str, Bool[Tensor, "m r"]]:
    """For each changed field, where it is no number or means nothing though it did before."""
    found = {}
    for name in changed(before, after):
        bad = _meaningless(name, getattr(after, name))
        if bool(bad.any()):
            bad = bad & ~_meaningless(name, getattr(before, name))
            if bool(bad.any()):
                found[name] = bad
    return found


def set_apart(
    before: Conditions, after: Conditions, bad: Bool[Tensor, "m r"], rows: Rows
) -> Conditions:
    """The conditions where bad elements, and rows that follow them, settle at NaN.

    All else about them is as it was before the effect.
    """
    bad = bad.expand(bad.shape[0], len(rows.share))
    bad = bad | bad[:, rows.follows]
    kept = {}
    for name in changed(before, after):
        old, value = getattr(before, name), getattr(after, name)
        kept[name] = torch.where(_like(bad, value), old, value)
    kept["give"] = torch.where(_like(bad, after.give), torch.nan, kept.get("give", after.give))
    return replace(after, **kept)


def known(
    before: Conditions, values: Tensor, rows: Rows, outcome: Outcome | None
) -> Bool[Tensor, " m"]:
    """Particles of which everything that an effect is given is a number."""
    fine = torch.isfinite(values).all(-1) & bool(torch.isfinite(rows.starts).all())
    parts = [getattr(before, name) for name in FIELDS]
    parts += [] if outcome is None else [outcome.pose, outcome.load, outcome.drag, outcome.arm]
    for part in parts:
        fine = fine & torch.isfinite(part).flatten(1).all(-1)
    return fine


def _meaningless(name: str, value: Tensor) -> Bool[Tensor, "m r"]:
    # A sum is no number where a part is none, and is had faster than a look at each of them.
    bad = ~value.sum(tuple(range(2, value.ndim))).isfinite()
    if name == "stiffness":
        bad = bad | (value <= 0).any(-1)
    if name == "compliance":
        bad = bad | (value < 0).any(-1)
    if name == "sensor":
        whole = torch.where(bad[..., None, None], torch.eye(3, dtype=value.dtype), value)
        bad = bad | (torch.linalg.det(whole).abs() < _LEAST_DETERMINANT)
    return bad


def _like(bad: Tensor, value: Tensor) -> Tensor:
    return bad.reshape(*bad.shape, *[1] * (value.ndim - 2))
