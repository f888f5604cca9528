"""The filter over a history in plain torch, and what any engine answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.kalman import FAR, PASSES, Innovation, assimilate, first_state, parted
from tpcd.belief.misfit import MisfitField, misfit_rows
from tpcd.belief.setting import Setting
from tpcd.contact import ContactScene
from tpcd.effects.conditions import angle_difference
from tpcd.planar import transform_points
from tpcd.simulator import ContactMode, StepSettings, StepStatus, simulate_step


@dataclass(frozen=True)
class Steps:
    """How the n transitions of m particles settled; NaN (mode: zero) where one was
    not stepped."""

    pose: Float[Tensor, "m n 3"]
    mode: Int[Tensor, "m n t"]
    contacts: Float[Tensor, "m n t 4"]
    """As in `Transition`."""


@dataclass(frozen=True)
class HistoryLikelihood:
    """What theta says about a history, m particles.

    `total` is the log likelihood, -inf for a particle that was given up; `field_mean` and
    `field_covariance` are the normal posterior of the misfit coefficients. Where they are asked
    for, `whitened` and `log_scale` are the innovations of the n transitions (see
    `kalman.Innovation`), NaN without one, and `slopes` the derivatives of `whitened` by d
    coordinates; `steps` how the transitions settled.
    """

    total: Float[Tensor, " m"]
    field_mean: Float[Tensor, "m c"]
    field_covariance: Float[Tensor, "m c c"]
    whitened: Float[Tensor, "m n 3"] | None = None
    log_scale: Float[Tensor, "m n 3"] | None = None
    slopes: Float[Tensor, "m d n 3"] | None = None
    steps: Steps | None = None

    def __getitem__(self, index: Tensor | slice) -> HistoryLikelihood:
        """Of some particles, without how their transitions settled."""
        values = {name: v[index] for name, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **values, steps=None)


def joined(parts: Sequence[HistoryLikelihood]) -> HistoryLikelihood:
    """What is said of some particles after another, all asked the same."""
    whole = {}
    for name, first in vars(parts[0]).items():
        values = [getattr(part, name) for part in parts]
        if isinstance(first, Steps):
            ways = zip(*(vars(value).values() for value in values), strict=True)
            whole[name] = Steps(*(torch.cat(way) for way in ways))
        else:
            whole[name] = None if first is None else torch.cat(values)
    return HistoryLikelihood(**whole)


def filter_history(
    points_ee: Float[Tensor, "m p 2"],
    setting: Setting,
    misfit_sd: Float[Tensor, " m"],
    field: MisfitField,
    settings: StepSettings,
    innovations: bool = False,
    steps: bool = False,
) -> HistoryLikelihood:
    """Step and filter all transitions that count, for outlines in the end-effector frame [m]."""
    finite = torch.isfinite(misfit_sd)
    sd = torch.where(finite, misfit_sd, 0.0)
    conditions, merged = setting.conditions, setting.merged
    m, n, terrains = len(sd), len(setting.used), conditions.offset.shape[-1]
    scene = conditions.scene(points_ee[:, None])
    count = field.bumps * terrains
    state = first_state(sd, count, merged.variance[:, 0])
    total = torch.zeros_like(misfit_sd)
    blank = Innovation(*(sd.new_full((m, 3), torch.nan) for _ in range(2)))
    each: list[Innovation] = []
    settled: list[tuple[Tensor, Tensor, Tensor]] = []
    nothing = (
        sd.new_zeros(m, 3),
        torch.zeros(m, terrains, dtype=torch.long, device=sd.device),
        sd.new_zeros(m, terrains, 4),
    )
    for k in range(n):
        variance = merged.variance[:, k + 1]
        if not setting.used[k]:
            state = parted(state, count, variance)
            each.append(blank)
            settled.append(nothing)
            continue
        begins, ends = (_turn(conditions.turn, row) for row in (k, k + 1))
        before, angle, here = state, setting.angles[k], _column(scene, k + 1)
        # What the field changes is known in part, and contact there is not as without it. The gap
        # at the end's angle serves for the start as well.
        gap = field.gap(state.mean[:, :count], angle) if count else None
        for again in range(PASSES):
            transition = simulate_step(
                here if gap is None else here.further(gap),
                merged.poses[:, k] - before.mean[:, count:] + begins,
                _row(conditions.target - conditions.carried, k + 1) + ends,
                _row(conditions.stiffness, k + 1),
                settings,
                previous=_row(conditions.target, k) + begins,
                unusual=True,
            )
            pose = transition.pose - ends + _row(conditions.give, k + 1)
            residual = angle_difference(merged.poses[:, k + 1], pose)
            if gap is not None:
                # As from no field at all, along the derivatives where it was stepped.
                residual = residual + (transition.pose_from_gap * gap[..., None]).sum(-2)
            rows, uncovered = misfit_rows(field, sd, angle, transition)
            usable = (transition.status <= int(StepStatus.RELAXED)) & finite
            usable = usable & torch.isfinite(residual).all(-1)
            # What is not usable must not reach a factorisation.
            parts = (residual, rows, transition.pose_from_start, uncovered)
            residual, rows, from_start, uncovered = (
                torch.where(usable.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0) for part in parts
            )
            state, found = assimilate(before, residual, rows, from_start, variance, uncovered)
            if gap is None or again == PASSES - 1:
                break
            if again == 0:
                first, explained, density = gap, found.explained, found.log_density
                known = field.gap(state.mean[:, :count], angle)
                moved = ends - _row(conditions.give, k + 1)
                touching = _touching(here, transition.mode, merged.poses[:, k + 1], pose, moved)
                stopped = (usable & ~explained)[:, None] & (touching < known)
                other = usable & ((known - gap).abs().amax(-1) > FAR) | stopped.any(-1)
                known = torch.where(stopped, touching, known)
                gap = torch.where(other[:, None], known, gap)
            else:
                lost = explained & ~found.explained
                other = usable & (lost | (stopped.any(-1) & ~(found.log_density > density)))
                gap = torch.where(other[:, None], first, gap)
            if not bool(other.any()):
                break
        total = total + torch.where(usable, found.log_density, -torch.inf)
        parts = (found.whitened, found.log_scale)
        each.append(Innovation(*(torch.where(usable[:, None], p, torch.nan) for p in parts)))
        settled.append((pose, transition.mode, transition.contacts))
    mean, covariance = state.mean[:, :count], state.covariance[:, :count, :count]
    whitened = log_scale = None
    if innovations:
        whitened = torch.stack([one.whitened for one in each], dim=1)
        log_scale = torch.stack([one.log_scale for one in each], dim=1)
    found_steps = None
    if steps:
        found_steps = Steps(*(torch.stack(part, 1) for part in zip(*settled, strict=True)))
    return HistoryLikelihood(total, mean, covariance, whitened, log_scale, steps=found_steps)


def _touching(
    scene: ContactScene, mode: Tensor, read: Tensor, pose: Tensor, moved: Tensor
) -> Tensor:
    """The field's gap (m, t) with which terrains that are not touched at a pose would just be
    touched at the one that was read, if they lie on the side where the object was held back;
    infinite for all others. The object itself is at a pose and what it is `moved` by."""
    read = read.expand(len(pose), -1)
    points = transform_points(read + moved, scene.points_ee)
    found = []
    for t, terrain in enumerate(scene.terrains):
        distance, nearest = terrain.signed_distance(points).min(-1)
        index = nearest[:, None, None].expand(-1, 1, 2)
        normal = terrain.normal(points.gather(1, index))[:, 0]
        held = ((read - pose)[:, :2] * normal).sum(-1) > FAR
        free = mode[:, t] == int(ContactMode.FREE)
        found.append(torch.where(held & free, -distance, torch.inf))
    return torch.stack(found, -1)


def _column(scene: ContactScene, row: int) -> ContactScene:
    """The scenes (m) at a row of the batch (m, r)."""
    count, device = scene.batch_shape[0], scene.friction.device
    column = scene.columns(torch.tensor([row], device=device))
    return column.gather(torch.arange(count, device=device))


def _row(value: Tensor, row: int) -> Tensor:
    """The value (m, 3) at a row of (m, r, 3), where r may be 1."""
    return value[:, row if value.shape[1] > 1 else 0]


def _turn(turn: Tensor, row: int) -> Tensor:
    """The turn at a row as a change of pose (m, 3)."""
    angle = _row(turn, row)
    return torch.cat((angle.new_zeros(len(angle), 2), angle), dim=-1)
