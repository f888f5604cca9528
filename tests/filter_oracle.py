"""The filter over a history in plain torch: the oracle of the compiled one.

The formulas are those of `tpcd.belief.filter`; only the contact step is shared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tpcd.belief.filter import HistoryLikelihood, Steps
from tpcd.belief.kernel_given import FAR, OUTLIER_SQUARE, PASSES
from tpcd.belief.misfit import MisfitField, misfit_rows
from tpcd.belief.setting import Setting
from tpcd.contact import ContactScene
from tpcd.effects.conditions import angle_difference
from tpcd.planar import transform_points
from tpcd.simulator import ContactMode, StepSettings, StepStatus, simulate_step


@dataclass(frozen=True)
class FieldState:
    """Normal belief over s = c + 3 numbers, the misfit coefficients and the error of the last
    pose, m particles."""

    mean: Float[Tensor, "m s"]
    covariance: Float[Tensor, "m s s"]


@dataclass(frozen=True)
class Innovation:
    """What a transition brings that was not known before, in independent standard units."""

    whitened: Float[Tensor, "m 3"]
    log_scale: Float[Tensor, "m 3"]
    """Logarithm of the units [log m, log m, log rad]."""

    @property
    def explained(self) -> Bool[Tensor, " m"]:
        """Whether it lies within `OUTLIER_SQUARE`."""
        return (self.whitened**2).sum(-1) < OUTLIER_SQUARE * (1 - 1e-9)

    @property
    def log_density(self) -> Float[Tensor, " m"]:
        """Log density of the transition's residual given those before."""
        each = 0.5 * self.whitened**2 + self.log_scale + 0.5 * math.log(2 * math.pi)
        return -each.sum(-1)


def first_state(
    sd: Float[Tensor, " m"], coefficients: int, variance: Float[Tensor, "*each 3"]
) -> FieldState:
    """Before any transition: coefficients of standard deviation sd, first pose of `variance`."""
    field = (sd**2)[:, None].expand(-1, coefficients)
    diagonal = torch.cat((field, variance.expand(len(sd), 3)), dim=-1)
    return FieldState(torch.zeros_like(diagonal), torch.diag_embed(diagonal))


def parted(state: FieldState, count: int, variance: Float[Tensor, "*each 3"]) -> FieldState:
    """The state past a transition that does not count: of the pose only its reading is known."""
    mean, covariance = state.mean.clone(), torch.zeros_like(state.covariance)
    mean[:, count:] = 0.0
    covariance[:, :count, :count] = state.covariance[:, :count, :count]
    covariance[:, count:, count:] = torch.diag_embed(variance)
    return FieldState(mean, covariance)


def assimilate(
    state: FieldState,
    residual: Float[Tensor, "m 3"],
    rows: Float[Tensor, "m 3 c"],
    from_start: Float[Tensor, "m 3 3"],
    variance: Float[Tensor, "*each 3"],
    uncovered: Float[Tensor, "m 3 3"],
) -> tuple[FieldState, Innovation]:
    """The state after a transition that started at the filtered pose, and its innovation."""
    count = rows.shape[-1]
    design = torch.cat((rows, -from_start), dim=-1)
    cross = state.covariance @ design.mT
    noise = torch.diag_embed(variance)
    covariance = design @ cross + noise + uncovered
    innovation = residual - (rows @ state.mean[:, :count, None])[..., 0]
    factor, whitened = _whiten(covariance, innovation)
    square = (whitened**2).sum(-1)
    growth = (square / OUTLIER_SQUARE).clamp_min(1.0)
    # Growing the covariance by a number stretches its factor by the root.
    factor, whitened = factor * growth.sqrt()[:, None, None], whitened / growth.sqrt()[:, None]
    found = Innovation(whitened, factor.diagonal(dim1=-2, dim2=-1).log())
    # The next state: the field goes on, the error of this pose takes the place of the last.
    answer = torch.cat((cross[:, :count], noise.expand_as(covariance)), dim=1)
    gain = torch.linalg.solve_triangular(factor, answer.mT, upper=False).mT
    keep = torch.cat((state.mean[:, :count], torch.zeros_like(innovation)), dim=-1)
    before = torch.zeros_like(state.covariance)
    before[:, :count, :count] = state.covariance[:, :count, :count]
    before[:, count:, count:] = noise
    mean = keep + (gain @ whitened[..., None])[..., 0]
    return FieldState(mean, before - gain @ gain.mT), found


def _whiten(covariance: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factor L of each covariance, and L^-1 vector."""
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(factor, vector[..., None], upper=False)
    return factor, whitened[..., 0]


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
        distance = terrain.signed_distance(points).amin(-1)
        held = ((read - pose)[:, :2] * terrain.direction).sum(-1) > FAR
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
